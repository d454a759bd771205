"""Coil and hysteresis together: the implicit steps of T&B (4) under one scan.

With k the loss of the coil, X = H + M and a = mu0 k / h, one step of the second-order backward formula reads
    a (3/2 X1 - 2 X0 + 1/2 X-1) + H1 = applied field 1,                         p = 1 + 3a/2,  q = 3a/2
and of the trapezoid rule
    a (X1 - X0) + (H1 + H0)/2 = (applied 0 + applied 1)/2,                      p = 1/2 + a,   q = a.
Both ask for p v + q M(v) = rhs: strictly monotone and piecewise quadratic in the field v. Corners that the step wipes
out follow from stored values, the cell by a search over the levels, the rest from a quadratic in closed form; where a
derivative is asked for, one Newton polish with a frozen slope, which adds nothing to the value, makes it exact.
The backward formula does not ring where the time constant mu0 k (1 + dM/dH) is far below the step, as at low frequency,
and turns into M(applied field) for k = 0; the trapezoid has the smaller error constant where the loop is resolved.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient

from ..constants import MU0
from ..effects.base import Trial
from ..errors import ConfigurationError
from ..preisach.everett import take
from ..preisach.memory import Memory, apply_field, branch_magnetization

SCHEMES = ("bdf2", "trapezoid")
LOSSES = ("source", "coil")  # blocks whose effects take from the applied field
CLOSE_ENOUGH = 1e-12  # of half the plane; the polish squares what is left
MOST_STEPS = 100  # each halves the bracket or the step


class _Carry(eqx.Module):
    memory: object
    X0: jax.Array
    X_before: jax.Array
    H0: jax.Array
    applied0: jax.Array
    states: tuple
    marks: tuple  # states of effects at the last end of a period


def solve_frozen(table, memory: Memory, p, q, rhs):
    """The field v with p v + q M(v) = rhs, without a derivative: (v, M(v), rising, kept)."""
    table, memory, p, q, rhs = stop_gradient((table, memory, p, q, rhs))
    rising = rhs >= p * memory.field + q * memory.magnetization
    up = jnp.sum(p * memory.maxima + q * memory.m_maxima > rhs)
    down = jnp.sum(p * memory.minima + q * memory.m_minima < rhs)
    kept = jnp.where(rising, up, down)
    v, m = _locate(table, memory.select(table, rising, kept), p, q, rhs)
    return v, m, rising, kept


@jax.custom_jvp
def solve_branch(table, memory: Memory, p, q, rhs):
    """As `solve_frozen`, with exact derivatives of v and M. The polish that makes them is done where one is asked for."""
    return solve_frozen(table, memory, p, q, rhs)


def _polished(given, tangents):
    v, m, rising, kept = solve_frozen(*given)
    leaves, tree = jax.tree.flatten(given)
    directions = tree.flatten_up_to(tangents)
    moving = [k for k, d in enumerate(directions) if type(d) is not SymbolicZero]

    def there(*moved):
        at = list(leaves)
        for k, leaf in zip(moving, moved, strict=True):
            at[k] = leaf
        table, memory, p, q, rhs = jax.tree.unflatten(tree, at)
        return polish(table, memory, rising, kept, v, p, q, rhs)

    (v, m), (dv, dm) = jax.jvp(there, [leaves[k] for k in moving], [directions[k] for k in moving])
    none = [np.zeros(x.shape, jax.dtypes.float0) for x in (rising, kept)]
    return (v, m, rising, kept), (dv, dm, *none)


solve_branch.defjvp(_polished, symbolic_zeros=True)


def polish(table, memory, rising, kept, v, p, q, rhs, extra=0.0, extra_slope=0.0):
    """One Newton step with frozen slope from a solution v of p v + q M(v) + extra = rhs: its value stays, to
    rounding, and every derivative becomes that of the implicit function."""
    _, _, threshold, m_there = memory.select(table, rising, kept)
    m_slope = _slope(*stop_gradient((table, v, threshold, rising)))
    m = branch_magnetization(table, rising, threshold, m_there, v)
    change = -((p * v + q * m - rhs) + extra) / stop_gradient(p + q * m_slope + extra_slope)
    return v + change, m + m_slope * change


def _level_values(table, cell, fixed, share, rising):
    """T on the branch at both ends of a cell: T(level, threshold) rising, T(threshold, level) falling."""
    width = table.cells + 1
    flat = table.values.ravel()
    here = jnp.where(rising, cell * width + fixed, fixed * width + cell)
    along, across = jnp.where(rising, width, 1), jnp.where(rising, 1, width)
    bend = share * (1 - share) * take(table.diagonal, fixed)
    first = (1 - share) * take(flat, here) + share * take(flat, here + across) - bend
    second = (1 - share) * take(flat, here + along) + share * take(flat, here + along + across) - bend
    return first, second


def _slope(table, field, threshold, rising):
    """dM/dv on a branch: 2 dT/dalpha rising, -2 dT/dbeta falling; zero outside the plane."""
    inside = (field > table.low) & (field < table.low + table.cells * table.step)
    cell, local = table.locate(field)
    first, second = _level_values(table, cell, *table.locate(threshold), rising)
    slope = (second - first) + (2 * local - 1) * take(table.diagonal, cell)
    return jnp.where(inside, jnp.where(rising, 2.0, -2.0) * slope / table.step, 0.0)


def _locate(table, branch, p, q, rhs):
    """The solution and M there, all inputs frozen: a search over the levels, then the quadratic of one cell."""
    rising, _, threshold, m_there = branch
    L, width = table.cells, table.cells + 1
    fixed, share = table.locate(threshold)
    sign = jnp.where(rising, 1.0, -1.0)
    flat = table.values.ravel()
    base = jnp.where(rising, fixed, fixed * width)
    along, across = jnp.where(rising, width, 1), jnp.where(rising, 1, width)
    constant = p * table.low + q * (m_there - 2 * sign * share * (1 - share) * take(table.diagonal, fixed)) - rhs

    def not_above(level):
        at = base + level * along
        T = (1 - share) * take(flat, at) + share * take(flat, at + across)
        value = constant + p * level * table.step + 2 * q * sign * T
        # rising the branch runs over the levels above the threshold, falling over those below it
        return jnp.where(rising, (level <= fixed) | (value <= 0), (value <= 0) & (level <= fixed))

    # the last level not above the solution, two levels at once in ever finer strides: where one or three are tried, the
    # compiler's loops are two to three times slower
    cell = 0
    for stride in _strides(L):
        levels = cell + stride * jnp.arange(1, 3)
        cell = cell + stride * jnp.sum(not_above(jnp.minimum(levels, L)) & (levels < L))

    # in the cell T = first + (second - first - D) z + D z^2; go from the anchor by the distance rho that is left
    first, second = _level_values(table, cell, fixed, share, rising)
    D = take(table.diagonal, cell)
    anchor = jnp.where(cell == fixed, share, jnp.where(rising, 0.0, 1.0))
    T_anchor = first + (second - first - D) * anchor + D * anchor**2
    slope = sign * (second - first - D + 2 * D * anchor)
    rho = sign * (rhs - p * (table.low + (cell + anchor) * table.step) - q * (m_there + 2 * sign * T_anchor))
    rho = jnp.maximum(rho, 0.0)
    b = p * table.step + 2 * q * slope
    z = anchor + sign * 2 * rho / (b + jnp.sqrt(b * b + 8 * q * D * rho))
    v = table.low + (cell + z) * table.step
    m = m_there + 2 * sign * (first + (second - first - D + D * z) * z)
    # outside the plane every relay is saturated and the equation linear
    m_top = table.offset + table.total
    above = p * (table.low + L * table.step) + q * m_top < rhs
    below = p * table.low + q * table.lowest > rhs
    m = jnp.where(above, m_top, jnp.where(below, table.lowest, m))
    return jnp.where(above | below, (rhs - q * m) / p, v), m


def _strides(cells):
    """Strides, coarse to fine, so that two levels tried at each end in one cell of so many."""
    strides = [1]
    while 3 * strides[-1] < cells:
        strides.append(3 * strides[-1])
    return strides[::-1]


def _extra_terms(effects, states, actuator, trial, p, q):
    """What the effects add to p v + q M = rhs, and the same split for the caller: (sum, H shift, added M)."""
    shift = loss = added = jnp.zeros_like(trial.field)
    for effect, state in zip(effects, states, strict=True):
        added = added + effect.magnetization(trial, state, actuator)
        if effect.block in LOSSES:
            loss = loss + effect.field_shift(trial, state, actuator)
        else:
            shift = shift + effect.field_shift(trial, state, actuator)
    return p * shift + q * added + loss, shift, added


class March(NamedTuple):
    """A march ready to go: the state at the first sample, the row (H, M, relay field, residual) there, and one step."""

    carry: object
    first: tuple
    advance: object


def march_of(actuator, applied, current, h, memory: Memory, scheme: str, period: int = 0) -> March:
    """The march of (4) from equilibrium at `applied`, A/m, and `current`, both scalars; the rest as in `march.magnetize`."""
    if scheme not in SCHEMES:
        raise ConfigurationError(f'scheme = "{scheme}" is unknown; write one of {", ".join(SCHEMES)}')
    for effect in actuator.effects:
        if effect.shells:
            from .shells import march_of_shells  # which is built on this module

            return march_of_shells(actuator, effect.share(), effect.shells, applied, current, h, memory, scheme, period)
    table = actuator.hysteresis.table()
    law = _law(actuator, h, scheme, period)
    carry, first = _at_rest(law, table, actuator, applied, current, h, memory)
    p, q = law.p, law.q

    def advance(c: _Carry, drive):
        rhs, trial_at = law.posed(c, drive)
        if law.effects:
            v, m, rising, kept, extra = _solve_with_effects(table, c, law.effects, actuator, trial_at, p, q, rhs)
        else:
            v, m, rising, kept = solve_branch(table, c.memory, p, q, rhs)
            extra = (0.0, 0.0, 0.0)
        residual = p * v + q * m + extra[0] - rhs
        if law.effects:  # the relays' own M at that field, so that a step that did not settle shows
            own, _, threshold, m_there = c.memory.branch(table, v)
            residual = residual + (branch_magnetization(table, own, threshold, m_there, v) - m)
        return law.after(c, drive, trial_at, v, m, extra, c.memory.move(rising, kept, v, m), residual)

    return March(carry, first, advance)


class _Law(NamedTuple):
    """One step of (4) apart from how it is solved: p v + q M + extra = rhs.

    `posed(carry, drive)`: (rhs, trial_at); `extra(states, trial)`: see `_extra_terms`; `after(carry, drive, trial_at, v, m,
    extra, memory, residual)`: (next carry, row).
    """

    effects: tuple
    p: jax.Array
    q: jax.Array
    extra: object
    posed: object
    after: object


def _law(actuator, h, scheme, period) -> _Law:
    effects = tuple(e for e in actuator.effects if e.in_step)
    a = MU0 * actuator.coil.loss / h
    bdf = scheme == "bdf2"
    p, q = (1 + 1.5 * a, 1.5 * a) if bdf else (0.5 + a, a)

    def posed(c, drive):
        applied1, current1, _, *given = drive
        old = a * (2 * c.X0 - 0.5 * c.X_before) if bdf else a * c.X0 - 0.5 * c.H0 + 0.5 * c.applied0
        rhs = old + (applied1 if bdf else 0.5 * applied1)
        if given:
            rhs = rhs - (p * given[0] + q * given[1] + given[2])

        def trial_at(v, m):
            X1 = v + m
            change = (1.5 * X1 - 2 * c.X0 + 0.5 * c.X_before) if bdf else X1 - c.X0
            return Trial(v, m, MU0 * change / h, (v - c.memory.field) / h, current1, h)

        return rhs, trial_at

    def extra(states, trial):
        return _extra_terms(effects, states, actuator, trial, p, q)

    def after(c, drive, trial_at, v, m, added, memory, residual):
        applied1, _, end, *given = drive
        trial = trial_at(v, m)
        states = tuple(e.advance(trial, s, actuator) for e, s in zip(effects, c.states, strict=True))
        H, M = v + added[1], m + added[2]
        if given:
            H, M = H + given[0], M + given[1]
        states, marks = _settle(effects, states, c.marks, end, period * h)
        return _Carry(memory, H + M, c.X0, H, applied1, states, marks), (H, M, v, residual)

    return _Law(effects, p, q, extra, posed, after)


def _at_rest(law: _Law, table, actuator, applied, current, h, memory: Memory):
    """The state at the first sample, at equilibrium, and the row (H, M, relay field, residual) there."""
    memory = apply_field(table, memory, applied)
    zero = jnp.zeros_like(memory.field)
    rest = Trial(memory.field, memory.magnetization, zero, zero, current, h)
    states = tuple(e.start(rest, actuator) for e in law.effects)
    _, shift, added = law.extra(states, rest)
    H, M = memory.field + shift, memory.magnetization + added
    X = H + memory.magnetization + added
    return _Carry(memory, X, X, H, applied, states, states), (H, M, memory.field, zero)


def run_march(march: March, applied, current, disturbance=None, period: int = 0):
    """All samples of a march: field H, magnetization M, relay field, residual, (time,) each, and overflow."""
    ends = _ends_of_periods(len(applied), period)
    drive = (applied[1:], current[1:], ends, *(d[1:] for d in disturbance or ()))
    carry, rows = jax.lax.scan(march.advance, march.carry, drive)
    # the first sample of a rod in shells is their mean
    whole = (jnp.concatenate([jnp.reshape(x.mean(), (1,)), y]) for x, y in zip(march.first, rows, strict=True))
    return *whole, carry.memory.overflow.any()


def run_until_steady(march: March, applied, current, tolerance, most):
    """The last of so many repetitions of a period that the next would be the same, from its second sample to its first.

    `applied`, `current`: one period and its first sample again, (period + 1,); `march`: of that `period`. It goes on until
    H + M in the second half of a period, behind its extrema, differs from the period before by less than `tolerance` of its
    peak to peak, or `most` periods are through. Returns field H, magnetization M, relay field, residual, (period,) each,
    overflow, and the last such difference. Not for reverse-mode derivatives.
    """
    count = len(applied) - 1
    drive = (applied[1:], current[1:], _ends_of_periods(count + 1, count))

    def going(state):
        _, _, change, number = state
        return (change > tolerance) & (number < most)

    def again(state):
        carry, (H0, M0, *_), _, number = state
        carry, rows = jax.lax.scan(march.advance, carry, drive)
        X, X0 = rows[0] + rows[1], H0 + M0
        change = period_change(X, X0)
        return carry, rows, jnp.where(number > 0, change, jnp.inf), number + 1

    rows = (jnp.zeros(count),) * 4
    carry, rows, change, _ = jax.lax.while_loop(going, again, (march.carry, rows, jnp.asarray(jnp.inf), 0))
    return *rows, carry.memory.overflow.any(), change


def period_change(X, before):
    """How much the second half of a period differs from that of the one before, relative to the period's peak to peak."""
    half = len(X) // 2
    return jnp.max(jnp.abs(X[half:] - before[half:])) / jnp.maximum(jnp.max(X) - jnp.min(X), 1e-300)


def _ends_of_periods(count, period):
    """Whether a period ends with each step of a march of `count` samples."""
    at = jnp.arange(1, count)
    return at % period == 0 if period else jnp.zeros(count - 1, bool)


def _settle(effects, states, marks, end, duration):
    """States and marks (the states at the last end of a period): where a period ends, slow states are led to their repeat."""
    settled, kept = [], []
    for effect, state, mark in zip(effects, states, marks, strict=True):
        if not effect.slow:
            settled.append(state), kept.append(state)
            continue
        there = effect.settled(state, mark, duration)
        settled.append(tuple(jnp.where(end, a, b) for a, b in zip(there, state, strict=True)))
        kept.append(tuple(jnp.where(end, a, b) for a, b in zip(there, mark, strict=True)))
    return tuple(settled), tuple(kept)


def disturbance_of(effect, actuator, field, magnetization, current, h, period: int = 0):
    """What an effect would add at every step of a trajectory that it does not change: see `march.magnetize`.

    `field`, `magnetization`: A/m, `current`: A, all (time,), of a march with the actuator's own coil; `period` as there.
    """
    scale = MU0 / h
    bdf = actuator.coil.scheme == "bdf2"
    X = field + magnetization
    zero = jnp.zeros_like(X[0])
    state = effect.start(Trial(field[0], magnetization[0], zero, zero, current[0], h), actuator)

    def advance(carry, now):
        state, mark, X0, X_before, before = carry
        v, m, drive, X1, end = now
        change = (1.5 * X1 - 2 * X0 + 0.5 * X_before) if bdf else X1 - X0
        trial = Trial(v, m, scale * change, (v - before) / h, drive, h)
        shift, added = effect.field_shift(trial, state, actuator), effect.magnetization(trial, state, actuator)
        loss = effect.block in LOSSES
        row = (zero if loss else shift, added, shift if loss else zero)
        (state,), (mark,) = _settle((effect,), (effect.advance(trial, state, actuator),), (mark,), end, period * h)
        return (state, mark, X1, X0, v), row

    ends = _ends_of_periods(len(field), period)
    rows = jax.lax.scan(advance, (state, state, X[0], X[0], field[0]), (field[1:], magnetization[1:], current[1:], X[1:], ends))[1]
    return tuple(jnp.concatenate([zero[None], r]) for r in rows)


def _solve_with_effects(table, c, effects, actuator, trial_at, p, q, rhs):
    """Safeguarded Newton on the whole equation, then the closed form with the effects' term frozen.

    The closed form on rhs - extra has the same bits as the base where every effect is at its null.
    """

    def extra_at(v, m):
        return _extra_terms(effects, c.states, actuator, trial_at(v, m), p, q)

    frozen_table, frozen_c, pf, qf, rf = stop_gradient((table, c, p, q, rhs))
    frozen_effects, frozen_actuator = stop_gradient((effects, actuator))

    def excess(v):
        rising, _, threshold, m_there = frozen_c.memory.branch(frozen_table, v)
        m = branch_magnetization(frozen_table, rising, threshold, m_there, v)
        extra = _extra_terms(frozen_effects, frozen_c.states, frozen_actuator, stop_gradient_trial(trial_at, v, m), pf, qf)[0]
        return pf * v + qf * m + extra - rf, extra

    v0, *_ = solve_frozen(frozen_table, frozen_c.memory, pf, qf, rf)
    reach = 0.5 * frozen_table.step * frozen_table.cells

    def refine(bracket):
        v, lo, hi, last, number = bracket
        (value, _), (slope, _) = jax.jvp(excess, (v,), (jnp.ones_like(v),))
        lo, hi = jnp.where(value <= 0, v, lo), jnp.where(value > 0, v, hi)
        newton = v - value / jnp.where(slope > 0, slope, pf)
        # by no more than half the last step, or it may go to and fro over a steep place for ever
        inside = (newton > lo) & (newton < hi) & (slope > 0) & (jnp.abs(newton - v) <= 0.5 * last)
        new = jnp.where(value == 0, v, jnp.where(inside, newton, 0.5 * (lo + hi)))
        return new, lo, hi, jnp.abs(new - v), number + 1

    def unsettled(bracket):
        return (bracket[3] > CLOSE_ENOUGH * reach) & (bracket[4] < MOST_STEPS)

    v, *_ = jax.lax.while_loop(unsettled, refine, (v0, v0 - reach, v0 + reach, reach, 0))
    v = stop_gradient(v)
    frozen_extra = stop_gradient(excess(v)[1])
    v, m, rising, kept = solve_frozen(frozen_table, frozen_c.memory, pf, qf, rf - frozen_extra)
    # live polish: the effects' term with its own derivative
    extra_slope = jax.jvp(excess, (v,), (jnp.ones_like(v),))[1][1]
    _, _, threshold, m_there = c.memory.select(table, rising, kept)
    live_m = branch_magnetization(table, rising, threshold, m_there, v)
    live_extra = extra_at(v, live_m)[0]
    v, m = polish(table, c.memory, rising, kept, v, p, q, rhs, live_extra, extra_slope)
    return v, m, rising, kept, extra_at(v, m)


def stop_gradient_trial(trial_at, v, m):
    """A trial whose history carries no derivative, at a field and magnetization that may."""
    fixed = stop_gradient(trial_at(stop_gradient(v), stop_gradient(m)))
    moved = trial_at(v, m)
    return Trial(*(f + (g - stop_gradient(g)) for f, g in zip(fixed, moved, strict=True)))
