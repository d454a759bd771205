"""hysteresis: magnetic after-effect (viscosity), a logarithmic creep of the magnetization at a held field."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged, power_of_time, repeated

TIMES = 10.0 ** np.arange(-4.0, 0.1, 0.5)  # s, two lags a decade make log time
N = len(TIMES)


class MagneticAftereffect(AbstractEffect):
    """A share of the magnetization arrives late, through a ladder of lags, equal a decade; or, `of_field`, of the field.

    Lags that are much longer than a period show as a smaller share alone, and those much shorter than the fastest change
    not at all: `shortest`, `exponent` and `longest` say how the lags between are spread.
    """

    share: Float[Array, ""] = param(
        0.0, "1", "share that arrives late, over all lags", low=0.0, scale=0.02, null=0.0, typical=(0.002, 0.2)
    )
    of_field: Float[Array, ""] = param(
        0.0,
        "1",
        "0: the relays' magnetization is late, 1: the field that they see",
        low=0.0,
        high=1.0,
        scale=0.5,
        shape=True,
        typical=(0.0, 1.0),
    )
    shortest: Float[Array, ""] = param(
        3e-4, "s", "lag below which there is less and less", low=1e-6, scale=3e-4, shape=True, detail=True, typical=(1e-5, 1e-1)
    )
    exponent: Float[Array, ""] = power_of_time((-0.3, 0.3))
    longest: Float[Array, ""] = param(
        3.0, "s", "lag above which there is less and less", low=1e-4, scale=3.0, shape=True, detail=True, typical=(1e-2, 1e2)
    )

    name = "magnetic_aftereffect"
    block = "hysteresis"
    law = (
        "M -> M + S (mean of lags of M - M), or v -> v + S (mean of lags of v - v); lags 0.1 ms .. 1 s, two a decade, "
        "weighing tau^exponent / ((1 + (shortest / tau)^2) (1 + (tau / longest)^2))"
    )
    source = (
        "R. Street, J. C. Woolley, Proc. Phys. Soc. A 62 (1949) 562: M(t) ~ S log t by a spread of times; "
        "L. Neel, J. Phys. Radium 11 (1950) 49: as a field"
    )
    signature = "a lag that hardly depends on frequency; the first periods drift"
    amplitude = "share"
    magnetic = True
    in_step = True
    slow = True

    def start(self, trial, actuator):
        """Lags of the departures of v and of M from where they rested, the last departures, the rest."""
        zero = jnp.zeros_like(trial.field)
        lags = jnp.zeros((N, *zero.shape))
        return (lags, lags, zero, zero, trial.field, trial.magnetization)

    def _weighted(self, lags):
        spread = (1 + (self.shortest / TIMES) ** 2) * (1 + (TIMES / self.longest) ** 2)
        weights = (TIMES / TIMES[-1]) ** self.exponent / spread
        return jnp.tensordot(weights / jnp.sum(weights), lags, 1)

    def _late(self, trial, lags, before, now):
        """The lags after the step; below half a step they are half a step."""
        times = TIMES.reshape(N, *(1,) * (lags.ndim - 1))
        return lagged(lags, before, now, trial.h, jnp.maximum(times, 0.5 * trial.h))

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        now = trial.field - state[4]
        return self.share * self.of_field * (now - self._weighted(self._late(trial, state[0], state[2], now)))

    def magnetization(self, trial, state, actuator):
        """What the relays' magnetization lacks, A/m."""
        now = trial.magnetization - state[5]
        return self.share * (1 - self.of_field) * (self._weighted(self._late(trial, state[1], state[3], now)) - now)

    def advance(self, trial, state, actuator):
        """The lags after the step."""
        now = trial.field - state[4], trial.magnetization - state[5]
        return (*(self._late(trial, state[k], state[k + 2], now[k]) for k in (0, 1)), *now, *state[4:])

    def settled(self, state, before, period):
        """The lags where they repeat."""
        times = TIMES.reshape(N, *(1,) * (state[0].ndim - 1))
        return (*(repeated(state[k], before[k], period, times) for k in (0, 1)), *state[2:])
