"""hysteresis: accommodation, the slow drift of minor loops with the number of reversals."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

MEMORY = 0.15  # share of the mean magnetization taken over at a reversal


class Accommodation(AbstractEffect):
    """At each reversal a running mean of M takes over a share of the present M; the relays' field is shifted by it.

    In detail it follows M all along instead, by the path that M goes: at a pace of 0.5 it makes up half of what it is behind on a path of 1.4 M_s.
    """

    shift: Float[Array, ""] = param(
        0.0, "A/m", "field shift at saturation of the running mean", scale=50.0, null=0.0, typical=(-500.0, 500.0)
    )
    pace: Float[Array, ""] = param(
        0.0, "1", "M_s over the path of M on which the mean follows all along; 0: at reversals", low=0.0, high=5.0, scale=0.5, shape=True,
        detail=True, typical=(0.1, 3.0),
    )  # fmt: skip

    name = "accommodation"
    block = "hysteresis"
    law = "H = v - shift a, a <- 0.85 a + 0.15 M/M_s at each reversal; with a pace p, da = p (M/M_s - a) |dM|/M_s all along"
    source = "E. Della Torre, IEEE Trans. Magn. 30 (1994) 2701 (accommodation model)"
    signature = "minor loops move from period to period and close only after many; offset loops most"
    amplitude = "shift"
    in_step = True

    def start(self, trial, actuator):
        """(running mean, last field, last direction, last M / M_s)."""
        zero = jnp.zeros_like(trial.field)
        return (zero, trial.field, zero, self._relative(trial, actuator))

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        return -self.shift * state[0]

    def advance(self, trial, state, actuator):
        """The mean moves where the field turned, or as M goes on."""
        mean, field, direction, before = state
        now, m = jnp.sign(trial.field - field), self._relative(trial, actuator)
        turned = now * direction < 0
        at_reversal = jnp.where(turned, (1 - MEMORY) * mean + MEMORY * m, mean)
        middle = 0.5 * (m + before)
        all_along = middle + (mean - middle) * jnp.exp(-self.pace * jnp.abs(m - before))
        taken = jnp.where(self.pace > 0, all_along, at_reversal)
        return (taken, trial.field, jnp.where(now == 0, direction, now), m)

    @staticmethod
    def _relative(trial, actuator):
        scale = actuator.strained.M_s if actuator.strained is not None else jnp.sum(actuator.hysteresis.masses)
        return trial.magnetization / scale
