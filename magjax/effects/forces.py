"""Helper for effects of the mechanics that add a force: the displacement that bears it."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..linear import inverse_of

HARMONICS = 32  # of a periodic drive, that Newton's method couples; the others see the mean stiffness and damping of the force
NEWTON, SOLVED = 20, 1e-8  # steps at most, and of the drive's own swing, what they may leave; mostly three or four
SHARES = (1.0, 0.5, 0.2)  # of a step, of which the one that leaves least is taken: a stop is met from far beyond it
BORNE = 4  # the same of one sample, under a drive that does not repeat
ROUNDS = 12  # of the fixed point for a force that is not local in time, under a drive that does not repeat


def with_force(displacement, force, given, series, line, actuator, local: bool = True):
    """The displacement that solves y = y_linear + G[force(y, given, series)], `force` in metres of equivalent free displacement.

    `given`: all that the force depends on beside y, `series`: that part of it which runs over time, a tuple of (time,). A
    fixed point swings up where a force changes the stiffness by as much as twice the damping ratio. So periodic drives are solved by Newton's method
    on the first harmonics (harmonic balance), until next to nothing is left, with live steps after it, which give every derivative; others sample by
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
    orders = jnp.arange(1, min(HARMONICS, (count - 1) // 2) + 1)
    angle = 2 * jnp.pi * jnp.outer(orders, jnp.arange(count)) / count
    basis = jnp.concatenate([jnp.full((1, count), 0.5**0.5), jnp.cos(angle), jnp.sin(angle)]) * (2 / count) ** 0.5  # orthonormal

    def inverse_at(y):
        """Of the first harmonics the inverse, and the mean stiffness and damping of the force as the last one of them meets it."""
        pushed = jax.vmap(lambda d: jax.jvp(lambda x: left(x, *frozen), (y,), (d,))[1])(basis) @ basis.T
        cos, sin = len(orders), 2 * len(orders)
        borne = 0.5 * (pushed[cos, cos] + pushed[sin, sin]) + 0.5j * (pushed[sin, cos] - pushed[cos, sin])
        s = 2j * jnp.pi * orders[-1] / (count * line.dt)
        mean = (1 - borne) / frozen[3].response(s)
        return inverse_of(pushed.T), mean.real, mean.imag / s.imag

    def step(y, known, r):
        """What r asks for: by the first harmonics jointly, by the others each for itself under the mean force."""
        inverse, stiffness, damping = known
        low = basis @ r
        rest = line.filter(r - low @ basis, lambda s: 1 / (1 - frozen[3].response(s) * (stiffness + damping * s)))
        return rest + (inverse @ low) @ basis

    def on(carry):
        y, r, _, k = carry
        change = step(y, inverse_at(y), r)
        tried = y - jnp.asarray(SHARES)[:, None] * change
        rows = jax.vmap(lambda x: left(x, *frozen))(tried)
        heights = jnp.sum(rows**2, axis=1)
        best = jnp.argmin(jnp.where(jnp.isfinite(heights), heights, jnp.inf))
        return tried[best], rows[best], heights[best], k + 1

    r = left(frozen[0], *frozen)
    least = (SOLVED**2) * jnp.sum((frozen[0] - jnp.mean(frozen[0])) ** 2)
    y = jax.lax.while_loop(lambda c: (c[2] > least) & (c[3] < NEWTON), on, (frozen[0], r, jnp.sum(r**2), 0))[0]
    known = inverse_at(y)
    for _ in range(3):  # live: the later ones are what the first harmonics do to the others
        y = y - step(y, known, left(y, *live))
    return y


def _marched(displacement, force, given, series, dt, mechanics):
    """From equilibrium; the force is linear in between the samples."""
    A, gain, rise = mechanics.held(dt)

    def borne(free, share, now):
        """y with y = free + share force(y), and the force there."""
        y = free
        for _ in range(BORNE):
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
