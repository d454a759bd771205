"""mechanics: a stiffness that grows (or falls) with the displacement."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force

STOP = 25.0  # of k5: the stiffness added at a third of the reach is then mostly that of the fifth power


class DuffingStiffness(AbstractEffect):
    """Spring that stiffens with the displacement: relative stiffness k3 r^2 (1 + k5 r^2), r = y / saturation displacement.

    In detail it is at rest at another place than the rod: r = (y - rest) / saturation displacement.
    """

    k3: Float[Array, ""] = param(
        0.0, "1", "relative stiffness added at saturation displacement", scale=0.1, null=0.0, typical=(-1.0, 2.0)
    )
    k5: Float[Array, ""] = param(
        0.0, "1", "its growth: relative stiffness k3 r^2 (1 + k5 r^2)", scale=1.0, shape=True, typical=(-1.0, 2.0)
    )
    rest: Float[Array, ""] = param(
        0.0,
        "1",
        "where the spring is at rest, of the saturation displacement",
        scale=0.2,
        shape=True,
        detail=True,
        typical=(-1.0, 1.0),
    )

    name = "duffing_stiffness"
    block = "mechanics"
    law = "y'' + 2 xi w0 y' + w0^2 (y + l k3 r^3 (1 + k5 r^2)) = w0^2 u, r = y/l - rest"
    source = "Duffing oscillator (A. H. Nayfeh, D. T. Mook, Nonlinear Oscillations, 1979)"
    signature = "odd distortion that follows y, not M, and shifts the resonance with amplitude"
    amplitude = "k3"

    @classmethod
    def elsewhere(cls, actuator):
        """A spring that is at rest within the stroke: about its null its stiffening looks like a softening."""
        return (cls(k3=0.6, rest=0.35),)

    def is_itself(self) -> bool:
        """Not where it grows so fast that it is a stop."""
        return bool(abs(self.k5) < STOP)

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with the cubic spring, m."""

        def spring(y, given, _):
            effect, reach = given
            r = y / reach - effect.rest
            return -reach * effect.k3 * r**3 * (1 + effect.k5 * r**2)

        return with_force(displacement, spring, (self, actuator.strained.reach), (), line, actuator)
