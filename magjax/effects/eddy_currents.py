"""coil: classical eddy currents, for a base that has none (a field-driven bench with k_eddy = 0)."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class EddyCurrents(AbstractEffect):
    """The linear eddy field k dB/dt of T&B (3), as an effect of its own."""

    k: Float[Array, ""] = param(
        0.0, "A/m per T/s", "eddy field per rate of the flux density", low=0.0, scale=0.1, null=0.0, typical=(1e-3, 10.0)
    )

    name = "eddy_currents"
    block = "coil"
    law = "H_eddy = k dB/dt"
    source = "T&B (3); for a thin rod k = sigma a^2 / 8 (G. Bertotti, Hysteresis in Magnetism, 1998)"
    signature = "loops widen in proportion to frequency"
    amplitude = "k"
    in_step = True

    def field_shift(self, trial, state, actuator):
        """Eddy field of the step's dB/dt, A/m."""
        return self.k * trial.flux_rate
