"""hysteresis: magnetic after-effect (viscosity), a logarithmic creep of the magnetization at a held field."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged

TIMES = (1e-3, 1e-2, 1e-1, 1.0)  # s, one lag a decade makes log time


class MagneticAftereffect(AbstractEffect):
    """The relays follow H through a ladder of lags, equal a decade: v + S sum_i (v - lag_i(v))/n = H."""

    share: Float[Array, ""] = param(0.0, "1", "share of the field that arrives late, over four decades", low=0.0, scale=0.02, null=0.0, typical=(0.002, 0.2))

    name = "magnetic_aftereffect"
    block = "hysteresis"
    law = "H = v + S (v - mean of lags of v), lags 1 ms .. 1 s, one a decade"
    source = "R. Street, J. C. Woolley, Proc. Phys. Soc. A 62 (1949) 562: M(t) ~ S log t"
    signature = "a lag that hardly depends on frequency; the first periods drift"
    amplitude = "share"
    in_step = True

    def start(self, trial, actuator):
        """Lags of the departure of v from where it rested, and the last departure and rest."""
        zero = jnp.zeros_like(trial.field)
        return (*(zero,) * len(TIMES), zero, trial.field)

    def _lags(self, trial, state):
        now = trial.field - state[-1]
        return [lagged(x, state[-2], now, trial.h, tau) for x, tau in zip(state[:-2], TIMES, strict=True)], now

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        lags, now = self._lags(trial, state)
        return self.share * (now - sum(lags) / len(TIMES))

    def advance(self, trial, state, actuator):
        """The lags after the step."""
        lags, now = self._lags(trial, state)
        return (*lags, now, state[-1])
