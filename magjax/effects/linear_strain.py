"""magnetostriction: a strain linear in M, from residual bias of the domains."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class LinearStrain(AbstractEffect):
    """A piezomagnetic part of the strain, odd in M."""

    d: Float[Array, ""] = param(0.0, "1", "linear share of the strain at saturation", scale=0.05, null=0.0, typical=(-0.5, 0.5))

    name = "linear_strain"
    block = "magnetostriction"
    law = "lambda = lambda_s (m^2 + d m)"
    source = "odd term of the strain expansion under residual stress bias (D. C. Jiles, 1995)"
    signature = "the two wings of the butterfly differ in height"
    amplitude = "d"

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with the linear term, m."""
        rod = actuator.magnetostriction
        return free_displacement + self.d * rod.reach * magnetization / rod.M_s
