"""Helper for effects of the mechanics that add a force: the displacement that bears it, by a fixed point."""

import jax


def with_force(displacement, force, line, actuator, rounds: int = 6):
    """The displacement that solves y = y_linear + G[force(y)], `force` in metres of equivalent free displacement.

    A fixed-point iteration over the whole signal. It converges for forces that are a modest part of the stiffness.
    """

    def correct(y, _):
        return displacement + line.filter(force(y), actuator.mechanics.response), None

    return jax.lax.scan(correct, displacement, length=rounds)[0]
