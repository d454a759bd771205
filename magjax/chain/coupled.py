"""Coil and hysteresis together: the implicit steps of T&B (4) under one scan.

With k the loss of the coil, X = H + M and a = mu0 k / h, one step of the second-order backward formula reads
    a (3/2 X1 - 2 X0 + 1/2 X-1) + H1 = applied field 1,                         p = 1 + 3a/2,  q = 3a/2
and of the trapezoid rule
    a (X1 - X0) + (H1 + H0)/2 = (applied 0 + applied 1)/2,                      p = 1/2 + a,   q = a.
Both ask for p v + q M(v) = rhs, strictly monotone in the field v: `closed_form`, and `newton` with what effects add to it.
The backward formula does not ring where the time constant mu0 k (1 + dM/dH) is far below the step, as at low frequency,
and turns into M(applied field) for k = 0; the trapezoid has the smaller error constant where the loop is resolved.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ..constants import MU0
from ..effects.base import Trial
from ..errors import ConfigurationError
from ..preisach.memory import Memory, apply_field, branch_magnetization
from .closed_form import solve_branch
from .loops import tied
from .newton import LOSSES, Posed, extra_of, extra_terms, solve_with_effects, trial_of

SCHEMES = ("bdf2", "trapezoid")
KEPT_FIRST, KEPT_LAST = 2, 3  # periods of a march of many that are kept whole


class _Carry(eqx.Module):
    memory: object
    X0: jax.Array
    X_before: jax.Array
    H0: jax.Array
    applied0: jax.Array
    states: tuple
    marks: tuple  # states of effects at the last end of a period
    before: tuple  # relay field and M a step earlier, where effects act in the step


class March(NamedTuple):
    """A march ready to go: the state at the first sample, the row (H, M, spread, relay field, residual) there, and one step."""

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
            posed = Posed(table, c, law.effects, actuator, drive[1], h, p, q, rhs)
            v, m, rising, kept = solve_with_effects(scheme, posed)
            extra = extra_of(scheme, posed, v, m)
        else:
            v, m, rising, kept = solve_branch(table, c.memory, p, q, rhs)
            extra = (0.0, 0.0, 0.0)
        residual = p * v + q * m + extra[0] - rhs
        if law.effects:  # the relays' own M at that field, so that a step that did not settle shows
            own, _, threshold, m_there = c.memory.branch(table, v)
            residual = residual + (branch_magnetization(table, own, threshold, m_there, v) - m)
        then, row = law.after(c, drive, trial_at, v, m, extra, c.memory.move(rising, kept, v, m), residual)
        if law.effects:
            then = dataclasses.replace(then, before=(c.memory.field, c.memory.magnetization))
        return then, row

    return March(carry, first, advance)


class _Law(NamedTuple):
    """One step of (4) apart from how it is solved: p v + q M + extra = rhs.

    `posed(carry, drive)`: (rhs, trial_at); `extra(states, trial)`: see `extra_terms`; `after(carry, drive, trial_at, v, m,
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
            return trial_of(scheme, c, current1, h, v, m)

        return rhs, trial_at

    def extra(states, trial):
        return extra_terms(effects, states, actuator, trial, p, q)

    def after(c, drive, trial_at, v, m, added, memory, residual):
        applied1, _, end, *given = drive
        trial = trial_at(v, m)
        states = tuple(e.advance(trial, s, actuator) for e, s in zip(effects, c.states, strict=True))
        H, M = v + added[1], m + added[2]
        if given:
            H, M = H + given[0], M + given[1]
        states, marks = _settle(effects, states, c.marks, end, period * h)
        return _Carry(memory, H + M, c.X0, H, applied1, states, marks, c.before), (H, M, jnp.zeros_like(v), v, residual)

    return _Law(effects, p, q, extra, posed, after)


def _at_rest(law: _Law, table, actuator, applied, current, h, memory: Memory):
    """The state at the first sample, at equilibrium, and the row (H, M, spread, relay field, residual) there."""
    memory = apply_field(table, memory, applied)
    carry, M = _rested(law, actuator, applied, current, h, memory)
    zero = jnp.zeros_like(memory.field)
    return carry, (carry.H0, M, zero, memory.field, zero)


def _rested(law: _Law, actuator, applied, current, h, memory: Memory):
    """The state at the first sample, the relays' field and M those of the memory, and M with what effects add."""
    zero = jnp.zeros_like(memory.field)
    rest = Trial(memory.field, memory.magnetization, zero, zero, current, h)
    states = tuple(e.start(rest, actuator) for e in law.effects)
    _, shift, added = law.extra(states, rest)
    H, M = memory.field + shift, memory.magnetization + added
    X = H + memory.magnetization + added
    before = (memory.field, memory.magnetization) if law.effects else ()
    return _Carry(memory, X, X, H, applied, states, states, before), M


def run_march(march: March, applied, current, disturbance=None, period: int = 0):
    """All samples of a march: field H, magnetization M, its spread, relay field, residual, (time,) each, and overflow."""
    ends = _ends_of_periods(len(applied), period)
    drive = (applied[1:], current[1:], ends, *(d[1:] for d in disturbance or ()))
    carry, rows = jax.lax.scan(march.advance, tied(march.carry, applied), drive)
    # the first sample of a rod in shells is their mean
    whole = (jnp.concatenate([jnp.reshape(x.mean(), (1,)), y]) for x, y in zip(march.first, rows, strict=True))
    return *whole, carry.memory.overflow.any()


def run_many(march: March, applied, current, times):
    """A period marched `times` times, a number that what is compiled does not know: more than `KEPT_FIRST + KEPT_LAST` of them.

    `applied`, `current`: one period and its first sample again, (period + 1,); `march`: of that `period`. Returns the rows of
    `march.advance` at the ends of the steps of the first KEPT_FIRST periods and of the last KEPT_LAST, one after the other.
    """
    count, kept = len(applied) - 1, KEPT_FIRST + KEPT_LAST
    drive = (applied[1:], current[1:], _ends_of_periods(count + 1, count))

    def again(k, state):
        carry, rows = jax.lax.scan(march.advance, state[0], drive)
        place = jnp.where(k < KEPT_FIRST, k, jnp.where(k < times - KEPT_LAST, kept - 1, k - times + kept))  # those between are written over
        return carry, jax.tree.map(lambda x, new: x.at[place].set(new), state[1], rows)

    one = jax.eval_shape(lambda carry: jax.lax.scan(march.advance, carry, drive)[1], march.carry)
    room = jax.tree.map(lambda x: jnp.zeros((kept, *x.shape), x.dtype), one)
    rows = jax.lax.fori_loop(0, times, again, tied((march.carry, room), applied))[1]
    return jax.tree.map(lambda x: jnp.reshape(x, (kept * count, *x.shape[2:])), rows)


def run_last(march: March, applied, current, times, stride):
    """The last of `times` repetitions of a period, every `stride`-th sample of it alone: numbers that what is compiled does not know.

    `applied`, `current`: one period, (period,), of which `stride` is a divisor; `march`: with the step and the `period` of what is marched.
    Returns field H, magnetization M and its spread, (period,) each, 0 between the samples marched; the highest and the lowest relay field.
    Not for derivatives.
    """
    size = len(applied)
    count = size // stride

    def again(k, state):
        carry, rows, highest, lowest = state
        j = (k + 1) % count
        place = j * stride
        carry, (H, M, spread, v, _) = march.advance(carry, (applied[place], current[place], j == 0))
        last = k + 1 == times * count  # the first sample of a period that would follow
        rows = tuple(x.at[place].set(jnp.where(last, x[place], new)) for x, new in zip(rows, (H, M, spread), strict=True))
        begins = j == 1
        highest, lowest = jnp.where(begins, v, jnp.maximum(highest, v)), jnp.where(begins, v, jnp.minimum(lowest, v))
        return carry, rows, highest, lowest

    v = jnp.mean(march.first[3])
    start = tied((march.carry, (jnp.zeros(size),) * 3, v, v), applied)
    _, *found = jax.lax.fori_loop(0, times * count, again, start)
    return found


def run_until_steady(march: March, applied, current, tolerance, most):
    """The last of so many repetitions of a period that the next would be the same, from its second sample to its first.

    `applied`, `current`: one period and its first sample again, (period + 1,); `march`: of that `period`. It goes on until
    H + M in the second half of a period, behind its extrema, differs from the period before by less than `tolerance` of its
    peak to peak, or `most` periods are through. Returns field H, magnetization M, its spread, relay field, residual,
    (period,) each, overflow, and the last such difference. Not for reverse-mode derivatives.
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

    rows = (jnp.zeros(count),) * 5
    carry, rows, change, _ = jax.lax.while_loop(going, again, tied((march.carry, rows, jnp.inf, 0), applied))
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
    rows = jax.lax.scan(advance, tied((state, state, X[0], X[0], field[0]), X), (field[1:], magnetization[1:], current[1:], X[1:], ends))[1]
    return tuple(jnp.concatenate([zero[None], r]) for r in rows)
