"""Helper for effects of the mechanics that add a force: their first-order response through G(s), iterated."""


def with_force(displacement, force, line, actuator, rounds: int = 6):
    """The displacement that solves y = y_linear + G[force(y)], `force` in metres of equivalent free displacement.

    A fixed-point iteration over the whole signal; it converges for forces that are a modest part of the stiffness.
    """
    y = displacement
    for _ in range(rounds):
        y = displacement + line.filter(force(y), actuator.mechanics.response)
    return y
