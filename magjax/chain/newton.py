"""One step of (4) where effects act in it: p v + q M(v) + what they add = rhs.

What the effects add is linearised in v and M, and the closed form solved with that: Newton's method for the effects alone,
from where the last step would lead. It takes two or three solutions, and one where the effects are linear. Steps that do not
settle so are bracketed. With every effect at its null p, q and rhs are those of the base, to the last bit.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..constants import MU0
from ..effects.base import Trial
from ..preisach.memory import branch_magnetization
from .closed_form import polish, pushed, slope_of, solve_frozen, unmoved
from .loops import tied

LOSSES = ("source", "coil")  # blocks whose effects take from the applied field
CLOSE_ENOUGH = 1e-12  # of half the plane; the polish squares what is left
MOST_LINEAR = 8  # linearisations, before it is bracketed
MOST_STEPS = 100  # each halves the bracket or the step


class Posed(NamedTuple):
    """A step to be solved. `carry`: of the march; `current`: A, at its end; `h`: s."""

    table: object
    carry: object
    effects: tuple
    actuator: object
    current: object
    h: object
    p: object
    q: object
    rhs: object


def trial_of(scheme: str, c, current, h, v, m) -> Trial:
    """What effects see at a trial field v with its M."""
    X1 = v + m
    change = (1.5 * X1 - 2 * c.X0 + 0.5 * c.X_before) if scheme == "bdf2" else X1 - c.X0
    return Trial(v, m, MU0 * change / h, (v - c.memory.field) / h, current, h)


def extra_of(scheme: str, posed: Posed, v, m):
    """See `extra_terms`."""
    trial = trial_of(scheme, posed.carry, posed.current, posed.h, v, m)
    return extra_terms(posed.effects, posed.carry.states, posed.actuator, trial, posed.p, posed.q)


def extra_terms(effects, states, actuator, trial, p, q):
    """What the effects add to p v + q M = rhs, and the same split for the caller: (sum, H shift, added M)."""
    shift = loss = added = jnp.zeros_like(trial.field)
    for effect, state in zip(effects, states, strict=True):
        added = added + effect.magnetization(trial, state, actuator)
        if effect.block in LOSSES:
            loss = loss + effect.field_shift(trial, state, actuator)
        else:
            shift = shift + effect.field_shift(trial, state, actuator)
    return p * shift + q * added + loss, shift, added


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def solve_with_effects(scheme: str, posed: Posed):
    """(v, M(v), rising, kept) with p v + q M(v) + what the effects add = rhs, with exact derivatives of v and M."""
    table, memory, p, q, rhs = posed.table, posed.carry.memory, posed.p, posed.q, posed.rhs
    reach = 0.5 * table.step * table.cells

    def added(v, m):
        return extra_of(scheme, posed, v, m)[0]

    def linear(v, m):
        there, push = jax.linearize(added, v, m)
        one, none = jnp.ones_like(v), jnp.zeros_like(v)
        return there, push(one, none), push(none, one)

    def again(state):
        (v, m), (there, by_v, by_m), *_, number = state
        v, m, rising, kept = solve_frozen(table, memory, p + by_v, q + by_m, rhs - there + (by_v * v + by_m * m))
        tangent = linear(v, m)
        return (v, m), tangent, rising, kept, p * v + q * m + tangent[0] - rhs, number + 1

    def open_yet(state):
        *_, left, number = state
        return ~(jnp.abs(left) <= CLOSE_ENOUGH * reach) & (number < MOST_LINEAR)

    before = posed.carry.before
    guess = 2 * memory.field - before[0], 2 * memory.magnetization - before[1]
    state = tied((guess, linear(*guess), False, 0, jnp.full_like(rhs, jnp.inf), 0), rhs)
    (v, m), _, rising, kept, left, _ = jax.lax.while_loop(open_yet, again, state)
    settled = jnp.abs(left) <= CLOSE_ENOUGH * reach
    return _bracketed(posed, added, reach, settled, (v, m, rising, kept))


def _bracketed(posed, added, reach, settled, found):
    """What was found where it has settled, else the same by safeguarded Newton's method from the field before."""
    table, memory, p, q, rhs = posed.table, posed.carry.memory, posed.p, posed.q, posed.rhs

    def excess(v):
        rising, kept, threshold, m_there = memory.branch(table, v)
        m = branch_magnetization(table, rising, threshold, m_there, v)
        return (p * v + q * m + added(v, m) - rhs, m), (rising, kept)

    def refine(walk):
        (v, *_), lo, hi, last, number = walk
        (value, m), (slope, m_slope), branch = jax.jvp(excess, (v,), (jnp.ones_like(v),), has_aux=True)
        lo, hi = jnp.where(value <= 0, v, lo), jnp.where(value > 0, v, hi)
        newton = v - value / jnp.where(slope > 0, slope, p)
        # by no more than half the last step, or it may go to and fro over a steep place for ever
        inside = (newton > lo) & (newton < hi) & (slope > 0) & (jnp.abs(newton - v) <= 0.5 * last)
        new = jnp.where(value == 0, v, jnp.where(inside, newton, 0.5 * (lo + hi)))
        return (new, m + m_slope * (new - v), *branch), lo, hi, jnp.abs(new - v), number + 1

    def unsettled(walk):
        return (walk[3] > CLOSE_ENOUGH * reach) & (walk[4] < MOST_STEPS)

    start = jnp.where(settled, found[0], memory.field)
    walk = tied(((start, *found[1:]), start - reach, start + reach, jnp.where(settled, 0.0, reach), 0), rhs)
    return jax.lax.while_loop(unsettled, refine, walk)[0]


def _polished(scheme, given, tangents):
    """The solution and its change: that of one Newton step from there with a frozen slope."""
    v, m, rising, kept = solve_with_effects(scheme, stop_gradient(given[0]))
    frozen = stop_gradient(given[0])
    _, _, threshold, _ = frozen.carry.memory.select(frozen.table, rising, kept)
    slope = slope_of(frozen.table, v, threshold, rising)
    extra_slope = jax.jvp(lambda x: extra_of(scheme, frozen, x, m + slope * (x - v))[0], (v,), (jnp.ones_like(v),))[1]

    def there(posed):
        memory = posed.carry.memory
        _, _, threshold, m_there = memory.select(posed.table, rising, kept)
        live = branch_magnetization(posed.table, rising, threshold, m_there, v)
        extra = extra_of(scheme, posed, v, live)[0]
        return polish(posed.table, memory, rising, kept, v, posed.p, posed.q, posed.rhs, extra, extra_slope)

    _, change = pushed(there, given, tangents)
    return (v, m, rising, kept), (*change, *map(unmoved, (rising, kept)))


solve_with_effects.defjvp(_polished, symbolic_zeros=True)


def stop_gradient_trial(trial_at, v, m):
    """A trial whose history carries no derivative, at a field and magnetization that may."""
    fixed = stop_gradient(trial_at(stop_gradient(v), stop_gradient(m)))
    moved = trial_at(v, m)
    return Trial(*(f + (g - stop_gradient(g)) for f, g in zip(fixed, moved, strict=True)))
