"""coil: domain-wall excess loss, an opposing field k sign(dB/dt) sqrt|dB/dt|."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class ExcessLoss(AbstractEffect):
    """Bertotti's excess field. `rate_knee` smooths the root near dB/dt = 0, where few walls move.

    In detail a share `full` of it follows his law of n0 and V0, which comes to the root later: there n0 V0 = k rate_knee^(1/2)
    and 4 sigma G S / (n0^2 V0) = 4 / rate_knee.
    """

    k: Float[Array, ""] = param(
        0.0, "A/m (s/T)^0.5", "excess field per root of dB/dt", low=0.0, scale=10.0, null=0.0, typical=(1.0, 200.0)
    )
    rate_knee: Float[Array, ""] = param(
        1.0, "T/s", "rate below which the field is linear in dB/dt", low=0.0, scale=1.0, shape=True, typical=(0.01, 100.0)
    )

    full: Float[Array, ""] = param(
        0.0, "1", "share of the law of n0 and V0", low=0.0, high=1.0, scale=0.5, shape=True, detail=True, typical=(0.0, 1.0)
    )

    name = "excess_loss"
    block = "coil"
    law = "H_exc = k r / (r^2 + rate_knee^2)^(1/4), in detail towards 2 k r / (rate_knee^(1/2) + (rate_knee + 4 |r|)^(1/2)), r = dB/dt"
    source = "G. Bertotti, IEEE Trans. Magn. 24 (1988) 621: H_exc = (n0 V0/2)(sqrt(1 + 4 sigma G S dB/dt/(n0^2 V0)) - 1)"
    signature = "loops widen as the root of the rate: more than eddy currents at low, less at high frequency"
    amplitude = "k"
    in_step = True

    def field_shift(self, trial, state, actuator):
        """Excess field of the step's dB/dt, A/m."""
        rate = trial.flux_rate
        root = 1 / (rate * rate + self.rate_knee**2 + 1e-12) ** 0.25
        knee = self.rate_knee + 1e-6
        walls = 2 / (knee**0.5 + (knee + 4 * jnp.abs(rate)) ** 0.5)
        return self.k * rate * (root + self.full * (walls - root))
