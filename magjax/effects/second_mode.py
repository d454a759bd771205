"""mechanics: a second mode of the structure beside the first."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class SecondMode(AbstractEffect):
    """A further second-order mode in parallel, driven by the same force, which takes its share of the static displacement.

    In detail it answers the force's rate too, and the first mode makes up for it so that the sum stays of second order at high
    frequency: modes whose damping is not spread as mass and stiffness are.
    """

    gain: Float[Array, ""] = param(0.0, "1", "static share of the second mode", scale=0.05, null=0.0, typical=(-0.5, 0.5))
    f2: Float[Array, ""] = param(1200.0, "Hz", "its frequency", low=0.0, scale=1200.0, shape=True, typical=(100.0, 5000.0))
    xi2: Float[Array, ""] = param(0.05, "1", "its damping ratio", low=0.0, scale=0.05, shape=True, typical=(0.005, 0.3))

    lead: Float[Array, ""] = param(
        0.0, "1", "its answer to the rate of the force, at f2", scale=0.1, shape=True, detail=True, typical=(-1.0, 1.0)
    )

    name = "second_mode"
    block = "mechanics"
    law = "Y = ((1 - gain) G + gain G2 + gain lead (s / w2) (G2 - (w2 / w0)^2 G)) U, G2 of f2, xi2"
    source = "modal superposition (D. J. Ewins, Modal Testing, 2000)"
    signature = "linear in the forcing: a resonance in the harmonics near f2, whichever drive makes them"
    amplitude = "gain"

    @classmethod
    def elsewhere(cls, actuator):
        """Two modes about the one that a plain fit takes them for, as of a mass on a spring that rides on the rod: one of them alone does little."""
        if actuator.mechanics is None:
            return ()
        return (cls(gain=0.3, f2=0.7 * float(actuator.mechanics.f0), xi2=0.1, lead=-0.5),)

    def is_itself(self) -> bool:
        """Not where it is overdamped: two lags and no mode, which imitate whatever relaxes."""
        return bool(self.xi2 < 1)

    def is_seen(self, highest: float) -> bool:
        """Not where its resonance is above all lines: what it does below is what a delay does."""
        return bool(self.f2 < highest)

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the second mode, m."""
        w2 = 2 * jnp.pi * self.f2

        def response(s):
            return w2**2 / (s * s + 2 * self.xi2 * w2 * s + w2**2)

        def rate(s):
            return response(s) * s / w2

        w0 = 2 * jnp.pi * actuator.mechanics.f0
        of_rate = line.filter(free_displacement, rate) - w2 / w0**2 * line.derivative(displacement)
        return displacement + self.gain * (line.filter(free_displacement, response) - displacement + self.lead * of_rate)
