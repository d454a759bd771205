"""mechanics: play between rod and load."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class Backlash(AbstractEffect):
    """A play operator of half-width g on the displacement: it follows only after the gap has closed."""

    gap: Float[Array, ""] = param(0.0, "m", "half the gap", low=0.0, scale=1e-7, null=0.0, typical=(1e-8, 5e-6))

    name = "backlash"
    block = "mechanics"
    law = "y -> play_gap(y)"
    source = "G. Tao, P. V. Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"
    signature = "flat tops at every turning point, as wide at 10 Hz as at 300 Hz"
    amplitude = "gap"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement after the gap, m."""
        lost = jnp.maximum(self.gap, 0.0)

        def follow(state, y):
            # the state is the play's departure from y in units of the gap: its derivative in the gap exists at zero gap
            state, before = state
            moved = jnp.where(lost > 0, (y - before) / jnp.where(lost > 0, lost, 1.0), jnp.sign(y - before) * 1e9)
            state = jnp.clip(state - moved, -1.0, 1.0)
            return (state, y), state

        start = (jnp.zeros_like(displacement[0]), displacement[0])
        if line.periodic:
            start, _ = jax.lax.scan(follow, start, displacement)
        _, place = jax.lax.scan(follow, start, displacement)
        return displacement + self.gap * place
