"""hysteresis: thermally activated switching, thresholds that grow with the logarithm of the rate."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class RateDependentSwitching(AbstractEffect):
    """Sharrock's law: the relays lag by gamma asinh(dM-rate): a field gamma asinh(dB/dt / rate0)."""

    gamma: Float[Array, ""] = param(0.0, "A/m", "coercive shift per e-fold of the rate", low=0.0, scale=10.0, null=0.0, typical=(1.0, 200.0))
    rate0: Float[Array, ""] = param(1.0, "T/s", "rate at which the shift sets in", low=0.0, scale=1.0, shape=True, typical=(0.01, 100.0))

    name = "rate_dependent_switching"
    block = "hysteresis"
    law = "H = v + gamma asinh((dB/dt) / rate0)"
    source = "M. P. Sharrock, J. Appl. Phys. 76 (1994) 6413: coercivity rises with the logarithm of the sweep rate"
    signature = "loops widen by equal steps a decade of frequency"
    amplitude = "gamma"
    in_step = True

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        return self.gamma * jnp.arcsinh(trial.flux_rate / (self.rate0 + 1e-9))
