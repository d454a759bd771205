"""mechanics: a stiffness that grows (or falls) with the displacement."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force


class DuffingStiffness(AbstractEffect):
    """Cubic spring about the mean position: relative stiffness k3 ((y - mean)/l_ref)^2, l_ref = saturation displacement."""

    k3: Float[Array, ""] = param(0.0, "1", "relative stiffness added at saturation displacement", scale=0.1, null=0.0, typical=(-1.0, 2.0))

    name = "duffing_stiffness"
    block = "mechanics"
    law = "y'' + 2 xi w0 y' + w0^2 (y + k3 (y/l)^2 y) = w0^2 u"
    source = "Duffing oscillator (A. H. Nayfeh, D. T. Mook, Nonlinear Oscillations, 1979)"
    signature = "odd distortion that follows y, not M, and shifts the resonance with amplitude"
    amplitude = "k3"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the cubic spring, m."""
        reach = actuator.magnetostriction.reach
        return with_force(displacement, lambda y: -self.k3 * (y / reach) ** 2 * y, line, actuator)
