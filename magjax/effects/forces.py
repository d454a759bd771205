"""Helper for effects of the mechanics that add a force: the displacement that bears it, by a damped fixed point."""

import jax


def with_force(displacement, force, line, actuator, rounds: int = 6, stiffness=0.0):
    """The displacement that solves y = y_linear + G[force(y)], `force` in metres of equivalent free displacement.

    A fixed-point iteration over the whole signal. It converges for forces that are a modest part of the stiffness; for one
    that hardens by s in places, `stiffness` = s/2 (relative to the rod's) keeps it so: each correction is that of a rod with
    this much more stiffness.
    """

    def correct(y, _):
        left = y - displacement - line.filter(force(y), actuator.mechanics.response)
        return y - left - line.filter(left, lambda s: 1 / (1 + stiffness * actuator.mechanics.response(s)) - 1), None

    return jax.lax.scan(correct, displacement, length=rounds)[0]
