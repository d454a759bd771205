"""mechanics: hysteretic damping, a loss angle that does not depend on frequency."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class StructuralDamping(AbstractEffect):
    """Complex stiffness w0^2 (1 + i eta)."""

    eta: Float[Array, ""] = param(0.0, "1", "loss factor", low=0.0, scale=0.02, null=0.0, typical=(0.001, 0.2))

    name = "structural_damping"
    block = "mechanics"
    law = "G = w0^2 / (s^2 + 2 xi w0 s + w0^2 (1 + i eta))"
    source = "R. E. D. Bishop, D. C. Johnson, The Mechanics of Vibration (1960): hysteretic damping"
    signature = "a phase lag of every harmonic that stays at low frequency"
    amplitude = "eta"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the complex stiffness, m."""

        def change(s):
            base = actuator.mechanics.response(s)
            loss = 1j * self.eta * (jnp.imag(s) > 0)
            return -base * loss * base / (1 + loss * base)

        return displacement + line.filter(free_displacement, change)
