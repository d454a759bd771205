"""mechanics: play between rod and load."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

PLACES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the gaps within their spread


class Backlash(AbstractEffect):
    """Play operators of half-width g on the displacement: it follows only after the gap has closed.

    In detail several gaps share the motion, and a part of it passes by them elastically.
    """

    gap: Float[Array, ""] = param(0.0, "m", "half the gap", low=0.0, scale=1e-7, null=0.0, typical=(1e-8, 5e-6))
    spread: Float[Array, ""] = param(
        0.0, "1", "half the range of the gaps, relative", low=0.0, high=1.0, scale=0.2, shape=True, detail=True, typical=(0.0, 1.0)
    )
    elastic: Float[Array, ""] = param(
        0.0, "1", "share of the motion that passes by", low=0.0, high=1.0, scale=0.1, shape=True, detail=True, typical=(0.0, 0.5)
    )

    name = "backlash"
    block = "mechanics"
    law = "y -> y + (1 - elastic)(mean_i play_i(y) - y), half-widths gap (1 - spread) .. gap (1 + spread)"
    source = "G. Tao, P. V. Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"
    signature = "flat tops at every turning point, as wide at 10 Hz as at 300 Hz"
    amplitude = "gap"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement after the gap, m."""
        shares = 1 + self.spread * jnp.asarray(PLACES)
        lost = jnp.maximum(self.gap, 0.0) * jnp.maximum(shares, 1e-3)

        def follow(state, y):
            # the states are the plays' departures from y in units of their gaps: their derivative in the gap exists at zero gap
            state, before = state
            moved = jnp.where(lost > 0, (y - before) / jnp.where(lost > 0, lost, 1.0), jnp.sign(y - before) * 1e9)
            state = jnp.clip(state - moved, -1.0, 1.0)
            return (state, y), jnp.mean(shares * state)

        start = (jnp.zeros_like(shares), displacement[0])
        if line.periodic:
            start, _ = jax.lax.scan(follow, start, displacement)
        _, place = jax.lax.scan(follow, start, displacement)
        return displacement + self.gap * (1 - self.elastic) * place
