"""coil: the field takes time to diffuse into the rod, so the eddy lag weakens at high frequency."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged, repeated

SHARES = (0.692, 0.131, 0.053, 0.124)  # 4/j0n^2 of the roots of J0, the rest lumped
RATES = (1.0, 5.27, 12.95, 30.0)  # (j0n/j01)^2
KNEE = 0.9  # share from which it bends towards 1: beyond 1 the field would run ahead of the flux and no step has a solution


class FieldDiffusion(AbstractEffect):
    """Skin effect of a cylinder: k dB/dt becomes a ladder of lags with the same total lag at low frequency."""

    kappa: Float[Array, ""] = param(0.0, "1", "share of the eddy field that diffuses", low=0.0, scale=0.3, null=0.0, typical=(0.05, 1.0))
    tau: Float[Array, ""] = param(3e-4, "s", "slowest time of diffusion", low=0.0, scale=3e-4, shape=True, typical=(2e-5, 3e-3))

    name = "field_diffusion"
    block = "coil"
    law = "k dB/dt -> k [dB/dt + kappa sum_n g_n (lag_n(dB/dt) - dB/dt)]"
    source = "diffusion in a conducting cylinder: Bessel modes with times mu sigma a^2 / j0n^2 (H. S. Carslaw, J. C. Jaeger, 1959, Sec. 7.6)"
    signature = "the eddy lag grows more slowly than frequency; loops at high frequency are narrower than R_eddy from low frequency says"
    amplitude = "kappa"
    in_step = True
    slow = True

    def start(self, trial, actuator):
        """No flux moves: all lags at zero, the last rate, the flux moved."""
        return (jnp.zeros_like(trial.field),) * (len(SHARES) + 2)

    def _lags(self, trial, state):
        before = state[-2]
        return [lagged(x, before, trial.flux_rate, trial.h, self.tau / r) for x, r in zip(state[:-2], RATES, strict=True)]

    def field_shift(self, trial, state, actuator):
        """What the lags lack of dB/dt, times k and kappa, A/m."""
        size = jnp.abs(self.kappa)
        share = jnp.where(size < KNEE, self.kappa, jnp.sign(self.kappa) * (KNEE + (1 - KNEE) * jnp.tanh((size - KNEE) / (1 - KNEE))))
        late = sum(g * (x - trial.flux_rate) for g, x in zip(SHARES, self._lags(trial, state), strict=True))
        return share * actuator.coil.loss * late

    def advance(self, trial, state, actuator):
        """The lags after the step."""
        return (*self._lags(trial, state), trial.flux_rate, state[-1] + trial.h * trial.flux_rate)

    def settled(self, state, before, period):
        """The lags where they repeat, the flux that the first periods leave behind taken off."""
        left = (state[-1] - before[-1]) / period
        lags = (repeated(x, y, period, self.tau / r) - left for x, y, r in zip(state[:-2], before[:-2], RATES, strict=True))
        return (*lags, *state[-2:])
