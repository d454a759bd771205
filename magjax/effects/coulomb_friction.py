"""mechanics: dry friction in guides and seals, a force against the velocity."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force


class CoulombFriction(AbstractEffect):
    """Friction as an equivalent displacement F/k, smooth below a velocity scale: -f tanh(y'/v_s)."""

    f: Float[Array, ""] = param(0.0, "m", "friction force over stiffness", low=0.0, scale=1e-7, null=0.0, typical=(1e-8, 5e-6))
    v_s: Float[Array, ""] = param(3e-4, "m/s", "velocity below which friction is viscous", low=0.0, scale=3e-4, shape=True, typical=(1e-5, 3e-2))

    name = "coulomb_friction"
    block = "mechanics"
    law = "force -k f tanh(y'/v_s); Coulomb's law as v_s -> 0"
    source = "C. Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419, and references there"
    signature = "a step at each turning point, of the same size at every amplitude and frequency"
    amplitude = "f"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with friction, m."""
        return with_force(displacement, lambda y: -self.f * jnp.tanh(line.derivative(y) / self.v_s), line, actuator, rounds=4)
