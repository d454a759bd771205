"""mechanics: Young's modulus depends on the magnetization (Delta-E effect)."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .forces import with_force


class DeltaE(AbstractEffect):
    """Relative stiffness 1 + e m^2: the resonance moves with M, and, `static`, the settled displacement under its force too.

    In detail the change with m^2 need not be even: `bend` of it comes early, as where the domains turn first.
    """

    e: Float[Array, ""] = param(
        0.0, "1", "relative change of stiffness from m = 0 to saturation", scale=0.1, null=0.0, typical=(-0.5, 1.0)
    )
    static: Float[Array, ""] = param(
        0.0,
        "1",
        "0: the free strain stays, 1: the rod gives way under a force",
        low=0.0,
        high=1.0,
        scale=0.5,
        shape=True,
        typical=(0.0, 1.0),
    )
    bend: Float[Array, ""] = param(
        0.0, "1", "0: even in m^2, 1: early, and level towards saturation", low=-1.0, high=1.0, scale=0.3, shape=True, detail=True, typical=(-0.5, 1.0)
    )

    name = "delta_e"
    block = "mechanics"
    law = "y'' + 2 xi w0 y' + w0^2 (y + e m^2 (1 + bend (1 - m^2)) (y - (1 - static) u)) = w0^2 u"
    source = "A. E. Clark, H. T. Savage, IEEE Trans. Sonics Ultrason. 22 (1975) 50 (giant Delta-E of Terfenol)"
    signature = "phase and gain near the resonance change with bias; rate-dependent distortion"
    amplitude = "e"
    magnetic = True

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with a stiffness that follows m^2, m."""
        square = (signals["magnetization"] / actuator.magnetostriction.M_s) ** 2

        def spring(y, effect, series):
            square, free = series
            return -effect.e * square * (1 + effect.bend * (1 - square)) * (y - (1 - effect.static) * free)

        return with_force(displacement, spring, self, (square, free_displacement), line, actuator)
