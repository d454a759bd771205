"""magnetostriction: a fourth power beside the square, lambda ~ m^2 + b (m^4 - m^2)."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class QuarticMagnetostriction(AbstractEffect):
    """The quartic term of an even expansion, keeping saturation strain."""

    b: Float[Array, ""] = param(0.0, "1", "share of the fourth power", scale=0.1, null=0.0, typical=(-0.8, 0.8))

    name = "quartic_magnetostriction"
    block = "magnetostriction"
    law = "lambda = lambda_s (m^2 + b (m^4 - m^2))"
    source = "D. C. Jiles, J. Phys. D 28 (1995) 1537: lambda(M) = sum gamma_i M^2i"
    signature = "even in M and rate-independent: curvature of the butterfly near saturation"
    amplitude = "b"

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with the quartic term, m."""
        square = (magnetization / actuator.magnetostriction.M_s) ** 2
        return free_displacement + self.b * actuator.magnetostriction.reach * (square * square - square)
