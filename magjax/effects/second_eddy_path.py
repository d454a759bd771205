"""coil: a second path for eddy currents, in a housing or sleeve, with its own time constant."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged, repeated


class SecondEddyPath(AbstractEffect):
    """A shorted turn that links the flux of the rod or, `air`, that of the coil beside it: two limits with all between.

    In detail half of its field is early by `spread` decades of its time: of two turns, or of a wall so thick that the field diffuses in.
    """

    kappa: Float[Array, ""] = param(
        0.0, "1", "its field relative to the rod's eddy field, or to the coil's", low=0.0, scale=0.3, null=0.0, typical=(0.02, 2.0)
    )
    tau: Float[Array, ""] = param(5e-4, "s", "L/R of the second path", low=0.0, scale=5e-4, shape=True, typical=(3e-5, 1e-2))
    air: Float[Array, ""] = param(
        0.0,
        "1",
        "share of the coil's own flux in what drives it: 0 round the rod, 1 round the coil",
        low=0.0,
        high=1.0,
        scale=0.5,
        shape=True,
        typical=(0.0, 1.0),
    )
    spread: Float[Array, ""] = param(
        0.0, "1", "decades by which half of its field has a shorter time", low=0.0, high=3.0, scale=0.3, shape=True, detail=True, typical=(0.0, 1.5)
    )

    name = "second_eddy_path"
    block = "coil"
    law = "H + k dB/dt + H2 = applied, tau dH2/dt + H2 = kappa ((1 - air) k dB/dt + air tau d(applied)/dt); in detail H2 is the mean of two, the other of tau / 10^spread"
    source = "lumped model of a conducting housing (shorted secondary winding)"
    signature = "an extra eddy lag that saturates above 1/(2 pi tau)"
    amplitude = "kappa"
    in_step = True
    slow = True

    def is_itself(self) -> bool:
        """Not where a turn round the coil opposes more field than the coil makes: then it is a lag of all that the current does."""
        return bool(self.kappa * self.air <= 1)

    def start(self, trial, actuator):
        """No current flows: the fields of its halves over kappa, what drives it, the applied field, the integral of the drive."""
        zero = jnp.zeros_like(trial.field)
        return (zero, zero, zero, zero + actuator.coil.applied_field(trial.current), zero)

    @property
    def _times(self):
        return self.tau, self.tau * 10.0**-self.spread

    def _driven(self, trial, state, actuator):
        applied = actuator.coil.applied_field(trial.current)
        change = (1 - self.air) * actuator.coil.loss * trial.flux_rate + self.air * self.tau * (applied - state[3]) / trial.h
        halves = (lagged(x, state[2], change, trial.h, tau) for x, tau in zip(state[:2], self._times, strict=True))
        return *halves, change, applied, state[4] + trial.h * change

    def field_shift(self, trial, state, actuator):
        """Field of the second path, A/m."""
        slow, early, *_ = self._driven(trial, state, actuator)
        return self.kappa * 0.5 * (slow + early)

    def advance(self, trial, state, actuator):
        """Its fields over kappa and the rest after the step."""
        return self._driven(trial, state, actuator)

    def settled(self, state, before, period):
        """Its field where it repeats, the flux that the first periods leave behind taken off."""
        left = (state[4] - before[4]) / period
        return *(repeated(x, y, period, tau) - left for x, y, tau in zip(state[:2], before[:2], self._times, strict=True)), *state[2:]
