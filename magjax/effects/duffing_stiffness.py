"""mechanics: a stiffness that grows (or falls) with the displacement."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force


class DuffingStiffness(AbstractEffect):
    """Spring that stiffens with the displacement: relative stiffness k3 r^2 (1 + k5 r^2), r = y / saturation displacement."""

    k3: Float[Array, ""] = param(
        0.0, "1", "relative stiffness added at saturation displacement", scale=0.1, null=0.0, typical=(-1.0, 2.0)
    )
    k5: Float[Array, ""] = param(
        0.0, "1", "its growth: relative stiffness k3 r^2 (1 + k5 r^2)", scale=1.0, shape=True, typical=(-1.0, 2.0)
    )

    name = "duffing_stiffness"
    block = "mechanics"
    law = "y'' + 2 xi w0 y' + w0^2 (y + k3 r^2 (1 + k5 r^2) y) = w0^2 u, r = y/l"
    source = "Duffing oscillator (A. H. Nayfeh, D. T. Mook, Nonlinear Oscillations, 1979)"
    signature = "odd distortion that follows y, not M, and shifts the resonance with amplitude"
    amplitude = "k3"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the cubic spring, m."""
        reach = actuator.strained.reach

        def spring(y):
            square = (y / reach) ** 2
            return -self.k3 * square * (1 + self.k5 * square) * y

        return with_force(displacement, spring, line, actuator)
