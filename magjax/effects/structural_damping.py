"""mechanics: hysteretic damping, a loss angle that does not depend on frequency."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class StructuralDamping(AbstractEffect):
    """Complex stiffness w0^2 (1 + loss), with the fractional Kelvin element loss = eta ((i w / w0)^a - 1) / sin(pi a / 2).

    Its imaginary part hardly changes with frequency where the exponent a is small; a causal solid then stiffens as the
    logarithm of frequency (dispersion 1). The classic constant loss factor does not (dispersion 0, a to 0). The mean level
    has the stiffness of `mean_below` decades under the resonance: at zero, the resonance's own.
    """

    eta: Float[Array, ""] = param(0.0, "1", "loss factor", low=0.0, scale=0.02, null=0.0, typical=(0.001, 0.2))
    dispersion: Float[Array, ""] = param(
        1.0, "1", "growth of the stiffness with frequency: 1 causal, 0 classic", scale=1.0, shape=True, typical=(0.0, 1.0)
    )
    exponent: Float[Array, ""] = param(
        0.05, "1", "order of the fractional derivative", low=0.0, scale=0.05, shape=True, typical=(0.01, 0.5)
    )
    mean_below: Float[Array, ""] = param(
        0.0, "1", "decades below the resonance, whose stiffness the mean level has", scale=2.0, shape=True, typical=(0.0, 5.0)
    )

    name = "structural_damping"
    block = "mechanics"
    law = "G = w0^2 / (s^2 + 2 xi w0 s + w0^2 (1 + eta ((i w/w0)^a - 1)/sin(pi a/2)))"
    source = "R. E. D. Bishop, D. C. Johnson, The Mechanics of Vibration (1960): hysteretic damping; R. L. Bagley, P. J. Torvik, J. Rheol. 27 (1983) 201: fractional"
    signature = "a phase lag of every harmonic that stays at low frequency"
    amplitude = "eta"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the complex stiffness, m."""

        def change(s):
            base = actuator.mechanics.response(s)
            w = jnp.imag(s)
            ratio = jnp.where(w > 0, w, 1.0) / (2 * jnp.pi * actuator.mechanics.f0)
            quarter = 0.5 * jnp.pi * jnp.maximum(self.exponent, 1e-6)
            power = ratio ** jnp.maximum(self.exponent, 1e-6)
            stiffer = (power * jnp.cos(quarter) - 1) / jnp.sin(quarter)
            softer = (10.0 ** (-jnp.maximum(self.exponent, 1e-6) * self.mean_below) - 1) / jnp.sin(quarter)
            loss = self.eta * jnp.where(w > 0, 1j * power + self.dispersion * stiffer, self.dispersion * softer)
            return -base * loss * base / (1 + loss * base)

        return displacement + line.filter(free_displacement, change)
