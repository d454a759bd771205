"""Helper for effects of the mechanics that add a force: the displacement that bears it."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..linear import inverse_of

HARMONICS = 32  # of a periodic drive, that Newton's method couples; the others follow by a fixed point
NEWTON = 4
ROUNDS = 12  # of the fixed point for a force that is not local in time, under a drive that does not repeat


def with_force(displacement, force, given, series, line, actuator, local: bool = True):
    """The displacement that solves y = y_linear + G[force(y, given, series)], `force` in metres of equivalent free displacement.

    `given`: all that the force depends on beside y, `series`: that part of it which runs over time, a tuple of (time,). A
    fixed point swings up where a force changes the stiffness by as much as twice the damping ratio. So periodic drives are solved by Newton's method
    on the first harmonics (harmonic balance), with one live step after it, which gives every derivative; others sample by
    sample, unless the force is not `local` in time: there only modest ones converge.
    """
    if line.periodic:
        return _balanced(displacement, force, given, series, line, actuator.mechanics)
    if local:
        return _marched(displacement, force, given, series, line.dt, actuator.mechanics)

    def again(y, _):
        return displacement + line.filter(force(y, given, series), actuator.mechanics.response), None

    return jax.lax.scan(again, displacement, length=ROUNDS)[0]


def _balanced(displacement, force, given, series, line, mechanics):
    def left(y, linear, given, series, mechanics):
        return y - linear - line.filter(force(y, given, series), mechanics.response)

    live = (displacement, given, series, mechanics)
    frozen = stop_gradient(live)
    count = displacement.shape[0]
    angle = 2 * jnp.pi * jnp.outer(jnp.arange(1, min(HARMONICS, (count - 1) // 2) + 1), jnp.arange(count)) / count
    basis = jnp.concatenate([jnp.full((1, count), 0.5**0.5), jnp.cos(angle), jnp.sin(angle)]) * (2 / count) ** 0.5  # orthonormal

    def inverse_at(y):
        pushed = jax.vmap(lambda d: jax.jvp(lambda x: left(x, *frozen), (y,), (d,))[1])(basis)
        return inverse_of(basis @ pushed.T)

    def step(y, inverse, terms):
        r = left(y, *terms)
        low = basis @ r
        return y - r + (low - inverse @ low) @ basis

    y = jax.lax.scan(lambda y, _: (step(y, inverse_at(y), frozen), None), frozen[0], length=NEWTON)[0]
    y = step(y, inverse_at(y), live)
    r = left(y, *live)  # what the first harmonics do to the others
    return y - r + (basis @ r) @ basis


def _marched(displacement, force, given, series, dt, mechanics):
    """From equilibrium; the force is linear in between the samples."""
    A, gain, rise = mechanics.held(dt)

    def borne(free, share, now):
        """y with y = free + share force(y), and the force there."""
        y = free
        for _ in range(NEWTON):
            F, slope = jax.jvp(lambda x: force(x, given, now), (y,), (jnp.ones_like(y),))
            y = y - (y - free - share * F) / (1 - share * slope)
        return y, force(y, given, now)

    def advance(carry, here):
        state, before = carry  # the motion that the force makes, and the force
        linear, *now = here
        rest = A @ state + (gain - rise) * before
        y, F = borne(linear + rest[0], rise[0], now)
        return (rest + rise * F, F), y

    first, F = borne(displacement[0], 1.0, [x[0] for x in series])
    start = (jnp.stack([first - displacement[0], jnp.zeros_like(first)]), F)
    _, y = jax.lax.scan(advance, start, (displacement[1:], *(x[1:] for x in series)))
    return jnp.concatenate([first[None], y])
