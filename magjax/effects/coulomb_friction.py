"""mechanics: dry friction in guides and seals, with the presliding of its bristles."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force

STEEPEST = 2.0  # f over presliding, both m: a rod springs back by 2 f at a turn, so that a shorter way hardly shows


class CoulombFriction(AbstractEffect):
    """Friction as an equivalent displacement F/k by Dahl's law in its exact step, smooth below a velocity scale.

    The way of presliding is taken as f/2 at least.
    """

    f: Float[Array, ""] = param(0.0, "m", "friction force over stiffness", low=0.0, scale=1e-7, null=0.0, typical=(1e-8, 5e-6))
    v_s: Float[Array, ""] = param(
        3e-5, "m/s", "velocity below which friction is viscous", low=0.0, scale=3e-4, shape=True, typical=(1e-6, 3e-2)
    )
    presliding: Float[Array, ""] = param(
        3e-8, "m", "way over which friction turns with the motion", low=0.0, scale=1e-7, shape=True, typical=(1e-9, 1e-5)
    )

    name = "coulomb_friction"
    block = "mechanics"
    law = "force -k f p, dp/dy = (tanh(y'/v_s) - sign(y') p)/presliding; Coulomb's law as v_s, presliding -> 0"
    source = "P. R. Dahl (1968); C. Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419, and references there"
    signature = "a step at each turning point, of the same size at every amplitude and frequency"
    amplitude = "f"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with friction, m."""
        way = jnp.maximum(jnp.maximum(self.presliding, self.f / STEEPEST), 1e-10)

        def force(y):
            aim = jnp.tanh(line.derivative(y) / jnp.maximum(self.v_s, 1e-9))
            keep = jnp.exp(-jnp.abs(y - jnp.roll(y, 1)) / way)
            if not line.periodic:
                keep = keep.at[0].set(1.0)  # unstrained at the start

            def join(a, b):  # p -> keep p + gain, one after the other
                return a[0] * b[0], a[1] * b[0] + b[1]

            kept, gained = jax.lax.associative_scan(join, (keep, (1 - keep) * aim.at[0].set(jnp.where(line.periodic, aim[0], 0.0))))
            start = gained[-1] / jnp.maximum(1 - kept[-1], 1e-12) if line.periodic else 0.0
            return -self.f * (kept * start + gained)

        return with_force(displacement, force, line, actuator, rounds=10, stiffness=jnp.minimum(0.5 * self.f / way, 0.8))
