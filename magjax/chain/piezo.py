"""Piezo stack: voltage V (V) -> polarization P (V) -> free displacement u (m), in place of coil and magnetostriction.

The voltage on the electrodes plays the field H, without a loss. The Preisach operator, in the part of M, makes of it what
switches; beside it stands what does not, most of a stack's motion: P = Gamma[V] + chi V, in the volts that a stack without
hysteresis would need. The strain is linear in P, u = stroke P / V_m, where that of T&B (5) is even in M.
Left out: creep (creep), the resistance before the stack's capacitance (amplifier_lag), rates (rate_dependent_switching).
"""

import equinox as eqx
from jaxtyping import Array, Float

from ..param import param


class Electrodes(eqx.Module):
    """Electrodes that bear a known voltage: the field of the relays is that voltage."""

    drive = "voltage"
    scheme = "bdf2"  # as a known field

    def applied_field(self, voltage):
        """The voltage itself, V."""
        return voltage

    @property
    def loss(self):
        """None: k of H + k dB/dt is zero."""
        return 0.0


class Piezo(eqx.Module):
    """The linear law of a stack, u = stroke P / V_m, or of a ferroelectric sample, P_m P / V_m: full scale by the data sheet."""

    stroke: Float[Array, ""] = param(42e-6, "m", "free displacement at V_m", low=0.0, typical=(2e-6, 3e-4))
    P_m: Float[Array, ""] = param(0.3, "C/m^2", "polarization at V_m, where that is read", low=0.0, typical=(0.01, 1.0))
    V_m: Float[Array, ""] = param(150.0, "V", "voltage at which they are stated", low=0.0, typical=(50.0, 1000.0))
    chi: Float[Array, ""] = param(0.7, "1", "part of the motion that does not switch", low=0.0, scale=0.5, typical=(0.3, 1.2))

    @property
    def reach(self):
        """Free displacement at full scale, m, as that of a rod at saturation."""
        return self.stroke

    @property
    def M_s(self):
        """Full scale of P, V: plays the saturation magnetization."""
        return self.V_m

    def polarization(self, switched, voltage):
        """P, V, of what the relays have switched, V, and the voltage."""
        return switched + self.chi * voltage

    def surface_charge(self, polarization):
        """P as it is measured, C/m^2."""
        return self.P_m * (polarization / self.V_m)

    def __call__(self, polarization):
        """Free displacement, m."""
        return self.stroke * (polarization / self.V_m)
