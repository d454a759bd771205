"""Magnetostriction: magnetization M (A/m) -> free displacement u (m) of the rod.

u = l_rod lambda_s mean (M/M_s)^2 over the section, the forcing of T&B (5) divided by w0^2.
Left out: the fourth power (quartic_magnetostriction), a linear part (linear_strain), hysteresis of its own (strain_hysteresis).
"""

import equinox as eqx
from jaxtyping import Array, Float

from ..param import param


class Magnetostriction(eqx.Module):
    """The quadratic law of T&B (5)."""

    lambda_s: Float[Array, ""] = param(1.313e-3, "1", "saturation magnetostriction", low=0.0, typical=(2e-5, 2e-3))
    M_s: Float[Array, ""] = param(7.87e5, "A/m", "saturation magnetization", low=0.0, typical=(3e5, 2e6))
    l_rod: Float[Array, ""] = param(5.13e-2, "m", "length of the rod", low=0.0, typical=(5e-3, 0.3))

    @property
    def reach(self):
        """Free displacement at saturation, l_rod lambda_s, m."""
        return self.l_rod * self.lambda_s

    def __call__(self, magnetization, spread=0.0):
        """Free displacement, m; `spread`: the variance of M over the section, A^2/m^2."""
        return self.reach * ((magnetization / self.M_s) ** 2 + spread / self.M_s**2)
