"""hysteresis: a reversible part of the magnetization, strongest where the irreversible part is small."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class ReversibleMagnetization(AbstractEffect):
    """State-dependent reversible susceptibility chi_r (1 - m^2), m = M/M_s of the relays."""

    chi_r: Float[Array, ""] = param(
        0.0, "1", "reversible susceptibility at m = 0", low=0.0, scale=0.5, null=0.0, typical=(0.1, 10.0)
    )

    name = "reversible_magnetization"
    block = "hysteresis"
    law = "dM_rev/dH = chi_r (1 - m^2)"
    source = "E. Della Torre, Magnetic Hysteresis (1999), state-dependent reversible component"
    signature = "minor loops keep a slope at their tips that does not depend on their size; diagonal masses absorb most of it"
    amplitude = "chi_r"
    magnetic = True
    in_step = True

    def _scale(self, actuator):
        return actuator.magnetostriction.M_s if actuator.magnetostriction is not None else jnp.sum(actuator.hysteresis.masses)

    def start(self, trial, actuator):
        """(M_rev, relays' field, relays' M) before the step."""
        return (jnp.zeros_like(trial.field), trial.field, trial.magnetization)

    def magnetization(self, trial, state, actuator):
        """M_rev at the trial field, A/m."""
        rev, field, M = state
        m = 0.5 * (M + trial.magnetization) / self._scale(actuator)
        return rev + self.chi_r * (1 - m * m) * (trial.field - field)

    def advance(self, trial, state, actuator):
        """State after the step."""
        return (self.magnetization(trial, state, actuator), trial.field, trial.magnetization)
