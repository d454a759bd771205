"""coil: a second path for eddy currents, in a housing or sleeve, with its own time constant."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged, repeated


class SecondEddyPath(AbstractEffect):
    """A shorted turn that links the flux of the rod or, `air`, that of the coil beside it: two limits with all between."""

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

    name = "second_eddy_path"
    block = "coil"
    law = "H + k dB/dt + H2 = applied, tau dH2/dt + H2 = kappa ((1 - air) k dB/dt + air tau d(applied)/dt)"
    source = "lumped model of a conducting housing (shorted secondary winding)"
    signature = "an extra eddy lag that saturates above 1/(2 pi tau)"
    amplitude = "kappa"
    in_step = True
    slow = True

    def is_itself(self) -> bool:
        """Not where a turn round the coil opposes more field than the coil makes: then it is a lag of all that the current does."""
        return bool(self.kappa * self.air <= 1)

    def start(self, trial, actuator):
        """No current flows: its field over kappa, what drives it, the applied field, the integral of the drive."""
        zero = jnp.zeros_like(trial.field)
        return (zero, zero, zero + actuator.coil.applied_field(trial.current), zero)

    def _driven(self, trial, state, actuator):
        applied = actuator.coil.applied_field(trial.current)
        change = (1 - self.air) * actuator.coil.loss * trial.flux_rate + self.air * self.tau * (applied - state[2]) / trial.h
        return lagged(state[0], state[1], change, trial.h, self.tau), change, applied, state[3] + trial.h * change

    def field_shift(self, trial, state, actuator):
        """Field of the second path, A/m."""
        return self.kappa * self._driven(trial, state, actuator)[0]

    def advance(self, trial, state, actuator):
        """Its field over kappa and the rest after the step."""
        return self._driven(trial, state, actuator)

    def settled(self, state, before, period):
        """Its field where it repeats, the flux that the first periods leave behind taken off."""
        left = (state[3] - before[3]) / period
        return (repeated(state[0], before[0], period, self.tau) - left, *state[1:])
