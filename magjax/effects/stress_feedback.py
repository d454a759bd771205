"""hysteresis: stress acts back on the magnetization (Villari effect), with the stress of the moving rod."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..constants import MU0
from ..param import param
from .base import AbstractEffect


class StressFeedback(AbstractEffect):
    """The relays see H + (3 lambda_s sigma/(mu0 M_s^2)) M with sigma = -stiffness (y + inertia y''/w0^2) from the mechanics (5).

    In detail the rod bears a mass beside its spring: inertia is the stiffness of rod and spring together over that of the spring.
    """

    stiffness: Float[Array, ""] = param(
        0.0, "Pa/m", "stress in the rod per displacement (preload spring, load)", low=0.0, scale=1e10, null=0.0, typical=(1e9, 1e12)
    )
    inertia: Float[Array, ""] = param(
        0.0,
        "1",
        "stress of the moved mass over that of the spring, by y''/w0^2 over y",
        scale=1.0,
        shape=True,
        detail=True,
        typical=(0.0, 20.0),
    )

    name = "stress_feedback"
    block = "hysteresis"
    law = "M = Gamma[H + (3 lambda_s sigma / (mu0 M_s^2)) M], sigma = -stiffness (y + inertia y''/w0^2)"
    source = "D. C. Jiles, J. Phys. D 28 (1995) 1537: stress field (3 sigma / (2 mu0)) d lambda / dM"
    signature = "the loop deforms where y is large, and through the resonance with frequency"
    amplitude = "stiffness"
    magnetic = True
    in_step = True

    @classmethod
    def elsewhere(cls, actuator):
        """A spring: where the density has bent to it nothing of its size shows at null."""
        return (cls(stiffness=1e10),)

    def start(self, trial, actuator):
        """(y, y', free displacement) at equilibrium."""
        free = actuator.magnetostriction(trial.magnetization)
        return (free, jnp.zeros_like(free), free)

    def _move(self, trial, state, actuator):
        y, rate, before = state
        h, w0, xi = trial.h, 2 * jnp.pi * actuator.mechanics.f0, actuator.mechanics.xi
        free = actuator.magnetostriction(trial.magnetization)
        # trapezoid on (y, y'): solve the 2 x 2 system for the mean rate
        mean = (rate + 0.5 * h * w0**2 * (0.5 * (free + before) - y)) / (1 + h * xi * w0 + 0.25 * h * h * w0**2)
        return y + h * mean, 2 * mean - rate, free

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        rod, mechanics = actuator.magnetostriction, actuator.mechanics
        y, rate, free = self._move(trial, state, actuator)
        pushed = free - y - mechanics.xi * rate / (jnp.pi * mechanics.f0)  # y''/w0^2
        return self.stiffness * (y + self.inertia * pushed) * 3 * rod.lambda_s / (MU0 * rod.M_s**2) * trial.magnetization

    def advance(self, trial, state, actuator):
        """The rod after the step."""
        return self._move(trial, state, actuator)
