"""hysteresis: thermally activated switching, thresholds that grow with the logarithm of the rate."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..constants import MU0
from ..param import param
from .base import AbstractEffect


class RateDependentSwitching(AbstractEffect):
    """Sharrock's law: the relays lag by gamma asinh of the sweep rate over rate0, that of the field or, `of_flux`, of B.

    B counts by the mean susceptibility chi of the plane, so that both rates are of one size, A/m/s. With `of_drive` the
    thresholds widen by the sweep rate of the applied field instead, whatever the relays' own rate is: the law of the
    rate-dependent play operators.
    """

    gamma: Float[Array, ""] = param(
        0.0, "A/m", "coercive shift per e-fold of the rate", low=0.0, scale=10.0, null=0.0, typical=(1.0, 200.0)
    )
    rate0: Float[Array, ""] = param(
        1e4, "A/m/s", "rate at which the shift sets in", low=0.0, scale=1e4, shape=True, typical=(1e2, 1e7)
    )
    of_flux: Float[Array, ""] = param(
        0.0,
        "1",
        "0: the rate of the field, 1: that of the flux density",
        low=0.0,
        high=1.0,
        scale=0.5,
        shape=True,
        typical=(0.0, 1.0),
    )
    of_drive: Float[Array, ""] = param(
        0.0,
        "1",
        "0: thresholds by the relays' own rate, 1: by that of the applied field",
        low=0.0,
        high=1.0,
        scale=0.5,
        shape=True,
        detail=True,
        typical=(0.0, 1.0),
    )

    name = "rate_dependent_switching"
    block = "hysteresis"
    law = (
        "H = v + gamma ((1 - of_drive) asinh(r / rate0) + of_drive asinh(|dH_app/dt| / rate0) r / sqrt(r^2 + rate0^2)), "
        "r = (1 - of_flux) dv/dt + of_flux dB/dt / (mu0 chi)"
    )
    source = (
        "M. P. Sharrock, J. Appl. Phys. 76 (1994) 6413: coercivity rises with the logarithm of the sweep rate; of_drive: "
        "M. Al Janaideh, C.-Y. Su, S. Rakheja, Smart Mater. Struct. 17 (2008) 035026: thresholds by the rate of the input"
    )
    signature = "loops widen by equal steps a decade of frequency"
    amplitude = "gamma"
    in_step = True

    def start(self, trial, actuator):
        """The drive, A, of the sample before."""
        return (trial.current,)

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        plane, coil, rate0 = actuator.hysteresis, actuator.coil, self.rate0 + 1e-3
        chi = 2 * jnp.sum(plane.masses) / (plane.high - plane.low)
        rate = (1 - self.of_flux) * trial.field_rate + self.of_flux * trial.flux_rate / (MU0 * chi)
        of_drive = (coil.applied_field(trial.current) - coil.applied_field(state[0])) / trial.h
        widened = jnp.arcsinh(jnp.abs(of_drive) / rate0) * rate / jnp.sqrt(rate**2 + rate0**2)
        return self.gamma * ((1 - self.of_drive) * jnp.arcsinh(rate / rate0) + self.of_drive * widened)

    def advance(self, trial, state, actuator):
        """The drive at this sample."""
        return (trial.current,)
