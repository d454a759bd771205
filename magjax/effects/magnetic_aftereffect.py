"""hysteresis: magnetic after-effect (viscosity), a logarithmic creep of the magnetization at a held field."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged, repeated

TIMES = (1e-3, 1e-2, 1e-1, 1.0)  # s, one lag a decade makes log time


class MagneticAftereffect(AbstractEffect):
    """A share of the magnetization arrives late, through a ladder of lags, equal a decade; or, `of_field`, of the field."""

    share: Float[Array, ""] = param(
        0.0, "1", "share that arrives late, over four decades", low=0.0, scale=0.02, null=0.0, typical=(0.002, 0.2)
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

    name = "magnetic_aftereffect"
    block = "hysteresis"
    law = "M -> M + S (mean of lags of M - M), or v -> v + S (mean of lags of v - v); lags 1 ms .. 1 s, one a decade"
    source = "R. Street, J. C. Woolley, Proc. Phys. Soc. A 62 (1949) 562: M(t) ~ S log t; L. Neel, J. Phys. Radium 11 (1950) 49: as a field"
    signature = "a lag that hardly depends on frequency; the first periods drift"
    amplitude = "share"
    magnetic = True
    in_step = True
    slow = True

    def start(self, trial, actuator):
        """Lags of the departures of v and M from where they rested, the last departures, the rest."""
        zero = jnp.zeros_like(trial.field)
        return (*(zero,) * (2 * len(TIMES) + 2), trial.field, trial.magnetization)

    def _lags(self, trial, state):
        n = len(TIMES)
        now = (trial.field - state[-2], trial.magnetization - state[-1])
        rows = (state[:n], state[n : 2 * n])
        late = [
            [lagged(x, old, new, trial.h, tau) for x, tau in zip(row, TIMES, strict=True)]
            for row, old, new in zip(rows, state[2 * n : 2 * n + 2], now, strict=True)
        ]
        return late, now

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        (lags, _), (now, _) = self._lags(trial, state)
        return self.share * self.of_field * (now - sum(lags) / len(TIMES))

    def magnetization(self, trial, state, actuator):
        """What the relays' magnetization lacks, A/m."""
        (_, lags), (_, now) = self._lags(trial, state)
        return self.share * (1 - self.of_field) * (sum(lags) / len(TIMES) - now)

    def advance(self, trial, state, actuator):
        """The lags after the step."""
        late, now = self._lags(trial, state)
        return (*late[0], *late[1], *now, *state[-2:])

    def settled(self, state, before, period):
        """The lags where they repeat."""
        times = (*TIMES, *TIMES)
        lags = (repeated(x, y, period, tau) for x, y, tau in zip(state, before, times, strict=False))
        return (*lags, *state[len(times) :])
