"""Coil: current I (A) -> applied field c0 I + H_bias (A/m), and the eddy-current loss between it and the field H.

T&B (3)-(4): dH/dt + dM/dt = c1 (I - (H - H_bias)/c0), c1 = R_eddy/(mu0 N_m A_m). Multiplied by c0/c1 this reads
H + k dB/dt = c0 I + H_bias with B = mu0 (H + M) and k = c0 N_m A_m / R_eddy: the form that the step integrates.
Left out: the skin effect (field_diffusion), domain-wall excess loss (excess_loss), losses in a housing (second_eddy_path).
"""

import equinox as eqx
from jaxtyping import Array, Float

from ..param import param


class Coil(eqx.Module):
    """A coil of N_m turns around a rod of cross-section A_m with eddy resistance R_eddy (T&B Fig. 4)."""

    R_eddy: Float[Array, ""] = param(70.0, "ohm", "eddy-current resistance, T&B (3)", low=0.0, scale=70.0, typical=(1.0, 1000.0))
    c0: Float[Array, ""] = param(1.54e4, "1/m", "coil factor, field per current", low=0.0, typical=(1e3, 1e5))
    H_bias: Float[Array, ""] = param(1.23e4, "A/m", "bias field of the permanent magnet", scale=1e4, typical=(0.0, 5e4))
    N_m: Float[Array, ""] = param(1300.0, "1", "number of turns", low=0.0, typical=(50.0, 5000.0))
    A_m: Float[Array, ""] = param(2.83e-5, "m^2", "cross-section of the rod", low=0.0, typical=(1e-6, 1e-3))

    drive = "current"
    scheme = "trapezoid"  # c1/c0 resolves the loop: the smaller error constant wins

    def applied_field(self, current):
        """c0 I + H_bias, A/m: the field without eddy currents."""
        return self.c0 * current + self.H_bias

    @property
    def loss(self):
        """k of H + k dB/dt = applied field, A/m per T/s."""
        return self.c0 * self.N_m * self.A_m / self.R_eddy


class FieldCoil(eqx.Module):
    """A coil whose applied field is known, as in a material test: H + k dB/dt = applied field."""

    k_eddy: Float[Array, ""] = param(
        0.0, "A/m per T/s", "eddy-current lag k in H + k dB/dt", low=0.0, scale=1.0, typical=(0.01, 10.0)
    )
    H_bias: Float[Array, ""] = param(0.0, "A/m", "offset of the applied field", scale=10.0, typical=(-50.0, 50.0))

    drive = "field"
    scheme = "bdf2"  # k may be small or zero, where the trapezoid rings

    def applied_field(self, field):
        """The applied field with its offset, A/m."""
        return field + self.H_bias

    @property
    def loss(self):
        """k of H + k dB/dt = applied field, A/m per T/s."""
        return self.k_eddy
