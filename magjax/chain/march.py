"""The whole march of (4), and its derivatives.

A derivative does not go through the march: once that has run it is known which corner of the memory each step left from
and where it ended, and the same steps are taken again on those branches alone, with no memory to carry (`_replay`). A fit
asks for the small derivatives of every step instead (`linearized`), and leads what it reads back through them.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient

from ..preisach.memory import Memory, apply_field, branch_magnetization
from .closed_form import pushed, unmoved
from .coupled import KEPT_FIRST, _at_rest, _ends_of_periods, _law, _rested, march_of, run_many, run_march
from .loops import tied
from .newton import stop_gradient_trial


def magnetize(actuator, applied, current, h, memory: Memory, scheme: str = "trapezoid", disturbance=None, period: int = 0):
    """March (4) from equilibrium: (field H, magnetization M, its spread, relay field, residual, overflow) over time.

    `applied`: c0 I + H_bias, A/m, (time,); `current` the drive, for effects; `h`: step, s; `memory`: the start state.
    The field H is that of (4); the relays see H less the shifts of hysteresis effects. `residual`: A/m, (time,).
    The spread is what the strain sees of the variance of M over the section, A^2/m^2: of a rod in shells, else zero.
    `disturbance`: what is added at every step as an effect would, (field shift, magnetization, loss), A/m, (time,) each.
    `period`: steps of a period where the drive repeats, else 0: at its ends slow states are led to where they repeat.
    """
    if any(e.shells for e in actuator.effects):
        return _march_all(scheme, period, actuator, applied, current, h, memory, disturbance)
    return _marched(scheme, period, actuator, applied, current, h, memory, disturbance)


def _march_all(scheme, period, actuator, applied, current, h, memory, disturbance):
    march = march_of(actuator, applied[0], current[0], h, memory, scheme, period)
    return run_march(march, applied, current, disturbance, period)


_marched = jax.custom_jvp(_march_all, nondiff_argnums=(0, 1))


def _derived(scheme, period, given, tangents):
    """The march and its change: that of its `_replay`."""
    marched = _marched(scheme, period, *given)

    def there(*given):
        return _replay(scheme, period, stop_gradient(marched[3]), *given)

    return marched, (*pushed(there, given, tangents)[1], unmoved(marched[-1]))


_marched.defjvp(_derived, symbolic_zeros=True)


class _Corners(NamedTuple):
    """What `Memory.branch` asks of a table where it is to tell corners by their numbers."""

    low: jax.Array
    lowest: jax.Array


class _Trace(NamedTuple):
    """Stands for the memory in a replay: the field, and (field, M) at every place where a corner can be, (places, 2)."""

    field: jax.Array
    places: jax.Array


def _places(table, memory: Memory, samples: int):
    """(field, M) at every place where a corner can be: the bottom of the plane, the memory's maxima and minima, each sample."""
    rows = [jnp.stack([table.low, table.lowest])[None]]
    rows += [jnp.stack(pair, axis=1) for pair in ((memory.maxima, memory.m_maxima), (memory.minima, memory.m_minima))]
    now = jnp.stack([memory.field, memory.magnetization])[None]
    return jnp.concatenate([*rows, now, jnp.zeros((samples - 1, 2))])


def _branches(table, memory: Memory, fields):
    """The branch of every sample after the first of a march: (rising, place of its corner as in `_places`, threshold)."""
    numbers = jnp.arange(1.0, 2 * memory.corners + 1).reshape(2, -1)
    first = 2 * memory.corners + 1.0
    memory = dataclasses.replace(memory, m_maxima=numbers[0], m_minima=numbers[1], magnetization=first)
    corners = _Corners(table.low, jnp.zeros(()))

    def advance(memory, now):
        field, number = now
        rising, kept, threshold, place = memory.branch(corners, field)
        return memory.move(rising, kept, field, number), (rising, place.astype(int), threshold)

    return jax.lax.scan(advance, tied(memory, fields), (fields[1:], first + jnp.arange(1.0, len(fields))))[1]


def _replay(scheme, period, fields, actuator, applied, current, h, memory, disturbance):
    """The march again, for its derivatives alone: (field H, magnetization M, its spread, relay field, residual), (time,) each.

    `fields`: the relay fields where it ended, frozen. The branches are known then: a step reads the field and M of its
    corner from where the corner arose, and no memory is carried. One Newton step with a frozen slope makes every
    derivative that of the implicit function.
    """
    count = len(fields)
    law = _law(actuator, h, scheme, period)
    table = actuator.hysteresis.table()
    carry, first = _at_rest(law, table, actuator, applied[0], current[0], h, memory)
    places = _places(table, carry.memory, count)
    known = _known(table, carry.memory, fields)
    carry = eqx.tree_at(lambda c: c.memory, carry, _Trace(carry.memory.field, places))

    def advance(c, now):
        drive, number, branch = now
        corner = jax.lax.optimization_barrier(c.memory.places.at[branch.place].get(mode="promise_in_bounds"))
        v, m, after = _again(law, c, drive, branch, corner)
        places = c.memory.places.at[number].add(jnp.stack([v, m]), mode="promise_in_bounds", unique_indices=True)
        return after(_Trace(v, places))

    drive = (applied[1:], current[1:], _ends_of_periods(count, period), *(d[1:] for d in disturbance or ()))
    numbers = places.shape[0] - count + jnp.arange(1, count)
    rows = jax.lax.scan(advance, tied(carry, applied), (drive, numbers, known))[1]
    return tuple(jnp.concatenate([x[None], y]) for x, y in zip(first, rows, strict=True))


class _Known(NamedTuple):
    """The branch of every step after the first, (steps,) each: the field where it ended, whether it rises, the place of its
    corner as in `_places`, the threshold there; M above the corner's is `base` + `rise` times the corner's field, and rises
    by `along` with the field."""

    field: jax.Array
    rising: jax.Array
    place: jax.Array
    threshold: jax.Array
    base: jax.Array
    rise: jax.Array
    along: jax.Array


def _known(table, memory: Memory, fields, period: int = 0) -> _Known:
    """The branches of a march through these relay fields; derivatives of the table go into `base`. `period`: of a long march, every one
    of which is taken to go a little beyond the one before: where it only comes back to its turning points, rounding would tell."""
    frozen, v = stop_gradient(table), fields[1:]
    memory, turning = stop_gradient((memory, fields))
    if period:
        middle = 0.5 * (jnp.max(turning[-period:]) + jnp.min(turning[-period:]))
        turning = turning + BEYOND * (turning - middle) * (jnp.arange(len(turning)) / period)
    rising, place, threshold = stop_gradient(_branches(frozen, memory, turning))
    if period:
        threshold = jnp.concatenate([_places(frozen, memory, 1)[:, 0], v])[place]
        threshold = stop_gradient(threshold)
    moved = jax.linearize(lambda x, y: branch_magnetization(frozen, rising, x, 0.0, y), threshold, v)[1]
    rise, along = moved(jnp.ones_like(v), jnp.zeros_like(v)), moved(jnp.zeros_like(v), jnp.ones_like(v))
    base = branch_magnetization(table, rising, threshold, 0.0, v) - rise * threshold
    return _Known(v, rising, place, threshold, base, rise, along)


def _again(law, c, drive, branch: _Known, corner):
    """A step on its known branch from its corner, (field, M): its end (v, m), and how to go on with a memory, (carry, row)."""
    rhs, trial_at = law.posed(c, drive)
    v, along = branch.field, branch.along
    m = corner[1] + branch.base + branch.rise * corner[0]
    slope, extra = law.p + law.q * along, 0.0
    if law.effects:
        extra = law.extra(c.states, trial_at(v, m))[0]

        def other(x):
            return law.extra(stop_gradient(c.states), stop_gradient_trial(trial_at, x, stop_gradient(m) + along * (x - v)))[0]

        slope = slope + jax.jvp(other, (v,), (jnp.ones_like(v),))[1]
    change = -(law.p * v + law.q * m - rhs + extra) / stop_gradient(slope)
    v, m = v + change, m + along * change
    extra = law.extra(c.states, trial_at(v, m)) if law.effects else (0.0, 0.0, 0.0)

    def after(memory):
        return law.after(c, drive, trial_at, v, m, extra, memory, law.p * v + law.q * m + extra[0] - rhs)

    return v, m, after


class Steps(eqx.Module):
    """A march to first order, step by step, of a rod in one or more shells. A state of d numbers goes from step to step; (field, M) of a
    shell after a step are a place from which later branches leave, numbered as in `_places`, `before` of them older than the first step.
    `slopes`, `place`, `rising`, `threshold` and `ended` are of the steps that `ends_taken` tells.

    `slopes`: (steps, d + 2 shells + 3, d + 3 shells + 5 + parameters), of (state after, relay fields, M of the relays, field H, magnetization, its spread)
    by (state before, fields and M of the corners, what is added to M of the relays, applied field, current, and the three of a
    disturbance, see `magnetize`, parameters). `place`: (steps, shells), of the corner; `rising`, `threshold`, A/m: of the branch.
    `ended`: (periods, d, states), of the state after the last step of every period by what the states of effects were a period earlier
    (`coupled._settle`), of none where no effect is slow; they stand last in a state. `rest`: (d, shells + 2 + parameters), of the first
    state by (M of the relays, applied field, current, parameters).
    `periods`: marched; of many that were `times` asked for the arrays over (steps + 1,) hold the first KEPT_FIRST and the last KEPT_LAST alone.
    `corners`: (2, corners), fields of maxima and minima before the first step; `moved`: (before, 2), of the older places by the applied field
    of the first sample. `field`, `magnetization`, `spread`: H, M and the variance of M over the section, (steps + 1,), `relay_field`: (steps + 1, shells), A/m.
    """

    slopes: jax.Array
    ended: jax.Array
    place: jax.Array
    rising: jax.Array
    threshold: jax.Array
    rest: jax.Array
    corners: jax.Array
    moved: jax.Array
    field: jax.Array
    magnetization: jax.Array
    spread: jax.Array
    relay_field: jax.Array
    periods: jax.Array


DISTURBED = 3  # numbers of a disturbance
BEYOND = 1e-7  # of the range of a period, by which each goes beyond the one before where there are many: more than steps are solved to
AT_FIRST = KEPT_FIRST  # periods that are taken to first order one by one: of a longer march the last stands for all after these


def ends_taken(samples: int, period: int) -> np.ndarray:
    """The samples at the ends of those steps of a march that `linearized` takes: of all, or of the first AT_FIRST periods and the last."""
    ends, first = np.arange(1, samples), AT_FIRST * period
    return ends if len(ends) <= first + period else np.concatenate([ends[:first], ends[-period:]])


def linearized(made, parameters, applied, current, h, corners: int, scheme: str, period: int, times=None) -> Steps:
    """The steps of a march; `made(parameters)`: the actuator, `parameters`: (parameters,); the rest as in `magnetize`.
    `times`: of how many periods it is, more than KEPT_FIRST + KEPT_LAST, where the drive is given over as many as these.

    Its derivatives by the drive, the density, the parameters and what effects add are products of these few numbers. Of a
    long march they are those of the first periods and the last: what takes so long to repeat changes little from one to the next.
    """
    actuator = made(parameters)
    table = actuator.hysteresis.table()
    start = actuator.hysteresis.memory(table, corners)
    memory = apply_field(table, start, applied[0])
    march = march_of(actuator, applied[0], current[0], h, start, scheme, period)
    shells = sum(e.shells for e in actuator.effects) or 1
    rest, shaped = _flat(march.carry)
    shaped_marks = ravel_pytree(march.carry.marks)[1]

    def advance(carry, drive):
        then, row = march.advance(carry, drive)
        relays = jnp.reshape(jnp.stack([then.memory.field, then.memory.magnetization]), (2, shells))
        return then, (_flat(carry)[0], ravel_pytree(carry.marks)[0], *relays, *row[:3])

    ends = _ends_of_periods(len(applied), period)
    if times is None:
        flat, marks, *rows = jax.lax.scan(advance, tied(march.carry, applied), (applied[1:], current[1:], ends))[1]
    else:
        flat, marks, *rows = run_many(march._replace(advance=advance), applied[: period + 1], current[: period + 1], times)
    first = (x * jnp.ones(shells) for x in (memory.field, memory.magnetization))
    v, m, H, M, spread = (jnp.concatenate([x[None], y]) for x, y in zip((*first, *(x.mean() for x in march.first[:3])), rows, strict=True))
    begun, taken = jnp.stack([applied[0], current[0]]), ends_taken(len(applied), period)
    long = len(taken) < len(applied) - 1
    known = jax.vmap(lambda v: _known(table, memory, v, period if long else 0), 1, 1)(v)
    flat, marks, ends, known = jax.tree.map(lambda x: x[taken - 1], (flat, marks, ends, known))
    applied, current = applied[taken], current[taken]
    older = jnp.broadcast_to(_places(table, memory, 1)[:, :, None], (2 * memory.corners + 2, 2, shells))
    places = jnp.concatenate([older, jnp.stack([v[1:], m[1:]], axis=1)])
    corner = jnp.take_along_axis(places, known.place[:, None], axis=0)
    cuts = np.cumsum([len(rest), shells, shells, shells, 2, DISTURBED])

    def one(given, marks, end, branch):
        flat, x, m, added, drive, disturbance, parameters = jnp.split(given, cuts)
        branch = branch._replace(base=branch.base + added)
        again = _stepping(made(parameters), h, scheme, period)[1]
        before = dataclasses.replace(shaped(flat), marks=shaped_marks(marks))
        v, m, after = again(before, (*drive, end, *disturbance), branch, (x, m))
        then, (H, M, spread, *_) = after(_Trace(jnp.reshape(v, march.carry.memory.field.shape), None))
        return jnp.concatenate([_flat(then)[0], jnp.ravel(v), jnp.ravel(m), jnp.stack([H, M, spread])])

    still = jnp.broadcast_to(jnp.concatenate([jnp.zeros(DISTURBED), parameters]), (len(taken), DISTURBED + len(parameters)))
    given = [flat, corner[:, 0], corner[:, 1], jnp.zeros_like(known.field), applied[:, None], current[:, None], still]
    given = jnp.concatenate(given, axis=1), marks, ends, known
    slopes = jax.vmap(jax.jacfwd(one))(*given)
    last = jax.tree.map(lambda x: x[period - 1 :: period], given)
    ended = jnp.zeros((len(last[0]), len(rest), 0))
    if any(e.slow for e in actuator.effects if e.in_step):
        ended = jax.vmap(jax.jacfwd(lambda marks, given: one(given[0], marks, *given[2:])[: len(rest)]))(last[1], last)

    def rested(given):
        m, (applied, current), parameters = given[:shells], given[shells : shells + 2], given[shells + 2 :]
        at = _Rest(applied * jnp.ones_like(march.carry.memory.field), jnp.reshape(m, march.carry.memory.field.shape))
        return _flat(_stepping(made(parameters), h, scheme, period)[0](applied, current, at))[0]

    begin = jnp.concatenate([m[0], begun, parameters])
    moved = jax.jacfwd(lambda x: _places(table, apply_field(table, start, x), 1))(begun[0])
    ends_of_memory = jnp.stack([memory.maxima, memory.minima])
    periods = jnp.asarray((len(v) - 1) // period if times is None else times)
    return Steps(slopes, ended, known.place, known.rising, known.threshold, jax.jacfwd(rested)(begin), ends_of_memory, moved, H, M, spread, v, periods)


class _Rest(NamedTuple):
    """Stands for the memory at the first sample."""

    field: jax.Array
    magnetization: jax.Array


def _flat(carry):
    """A carry in one row, of its memory the field alone and nothing that is a copy, and how to shape it again."""
    less = {"before": ()} if hasattr(carry, "before") else {}
    return ravel_pytree(dataclasses.replace(carry, memory=_Trace(carry.memory.field, None), marks=(), **less))


def _stepping(actuator, h, scheme, period):
    """The state at rest, of (applied, current, memory), and a step on known branches, of (carry, drive, branch, corner), of an actuator; fields and M
    of the shells have an axis."""
    cut = next((e for e in actuator.effects if e.shells), None)
    if cut is not None:
        from .shells import _rod, again_in_shells, rested_shells  # which is built on this module

        rod = _rod(actuator, cut.share(), cut.shells, h, scheme, period)
        return (
            lambda applied, current, memory: rested_shells(rod, actuator, applied, current, h, memory)[0],
            lambda *given: again_in_shells(rod, actuator, *given),
        )
    law = _law(actuator, h, scheme, period)

    def again(c, drive, branch, corner):
        return _again(law, c, drive, jax.tree.map(lambda x: x[0], branch), (corner[0][0], corner[1][0]))

    return lambda applied, current, memory: _rested(law, actuator, applied, current, h, memory)[0], again
