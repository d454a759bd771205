"""hysteresis: accommodation, the slow drift of minor loops with the number of reversals."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

MEMORY = 0.15  # share of the mean magnetization taken over at a reversal


class Accommodation(AbstractEffect):
    """At each reversal a running mean of M takes over a share of the present M; the relays' field is shifted by it."""

    shift: Float[Array, ""] = param(
        0.0, "A/m", "field shift at saturation of the running mean", scale=50.0, null=0.0, typical=(-500.0, 500.0)
    )

    name = "accommodation"
    block = "hysteresis"
    law = "H = v - shift a, a <- 0.85 a + 0.15 M/M_s at each reversal"
    source = "E. Della Torre, IEEE Trans. Magn. 30 (1994) 2701 (accommodation model)"
    signature = "minor loops move from period to period and close only after many; offset loops most"
    amplitude = "shift"
    in_step = True

    def start(self, trial, actuator):
        """(running mean, last field, last direction)."""
        zero = jnp.zeros_like(trial.field)
        return (zero, trial.field, zero)

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        return -self.shift * state[0]

    def advance(self, trial, state, actuator):
        """The mean moves where the field turned."""
        mean, field, direction = state
        now = jnp.sign(trial.field - field)
        turned = now * direction < 0
        scale = actuator.strained.M_s if actuator.strained is not None else jnp.sum(actuator.hysteresis.masses)
        taken = (1 - MEMORY) * mean + MEMORY * trial.magnetization / scale
        return (jnp.where(turned, taken, mean), trial.field, jnp.where(now == 0, direction, now))
