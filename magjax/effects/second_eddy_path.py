"""coil: a second path for eddy currents, in a housing or sleeve, with its own time constant."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged


class SecondEddyPath(AbstractEffect):
    """A shorted turn round the rod: tau dI2/dt + I2 = kappa times the rod's eddy current."""

    kappa: Float[Array, ""] = param(0.0, "1", "strength relative to the rod's eddy current", low=0.0, scale=0.3, null=0.0, typical=(0.02, 2.0))
    tau: Float[Array, ""] = param(5e-4, "s", "L/R of the second path", low=0.0, scale=5e-4, shape=True, typical=(3e-5, 1e-2))

    name = "second_eddy_path"
    block = "coil"
    law = "H + k dB/dt + H2 = applied, tau dH2/dt + H2 = kappa k dB/dt"
    source = "lumped model of a conducting housing (shorted secondary winding)"
    signature = "an extra eddy lag that saturates above 1/(2 pi tau)"
    amplitude = "kappa"
    in_step = True

    def start(self, trial, actuator):
        """No current flows."""
        return (jnp.zeros_like(trial.field), jnp.zeros_like(trial.field))

    def field_shift(self, trial, state, actuator):
        """Field of the second path, A/m."""
        return self.kappa * actuator.coil.loss * lagged(state[0], state[1], trial.flux_rate, trial.h, self.tau)

    def advance(self, trial, state, actuator):
        """The current after the step, as a rate."""
        return (lagged(state[0], state[1], trial.flux_rate, trial.h, self.tau), trial.flux_rate)
