"""The whole march of (4), and its derivatives.

A derivative does not go through the march: once that has run it is known which corner of the memory each step left from
and where it ended, and the same steps are taken again on those branches alone, with no memory to carry. A fit's
derivatives, hundreds of directions at once, take a fifth of the time.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..preisach.memory import Memory, branch_magnetization
from .closed_form import pushed, unmoved
from .coupled import _at_rest, _ends_of_periods, _law, march_of, run_march
from .newton import stop_gradient_trial


def magnetize(actuator, applied, current, h, memory: Memory, scheme: str = "trapezoid", disturbance=None, period: int = 0):
    """March (4) from equilibrium: (field H, magnetization M, relay field, residual, overflow) over time.

    `applied`: c0 I + H_bias, A/m, (time,); `current` the drive, for effects; `h`: step, s; `memory`: the start state.
    The field H is that of (4); the relays see H less the shifts of hysteresis effects. `residual`: A/m, (time,).
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
        return _replay(scheme, period, stop_gradient(marched[2]), *given)

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

    return jax.lax.scan(advance, memory, (fields[1:], first + jnp.arange(1.0, len(fields))))[1]


def _replay(scheme, period, fields, actuator, applied, current, h, memory, disturbance):
    """The march again, for its derivatives alone: (field H, magnetization M, relay field, residual), (time,) each.

    `fields`: the relay fields where it ended, frozen. The branches are known then: a step reads the field and M of its
    corner from where the corner arose, and no memory is carried. One Newton step with a frozen slope makes every
    derivative that of the implicit function.
    """
    count = len(fields)
    law = _law(actuator, h, scheme, period)
    table = actuator.hysteresis.table()
    carry, first = _at_rest(law, table, actuator, applied[0], current[0], h, memory)
    places = _places(table, carry.memory, count)
    known = places.shape[0] - count
    frozen, v = stop_gradient(table), fields[1:]
    rising, place, threshold = stop_gradient(_branches(frozen, stop_gradient(carry.memory), fields))
    moved = jax.linearize(lambda x, y: branch_magnetization(frozen, rising, x, 0.0, y), threshold, v)[1]
    rise, along = moved(jnp.ones_like(v), jnp.zeros_like(v)), moved(jnp.zeros_like(v), jnp.ones_like(v))
    base = branch_magnetization(table, rising, threshold, 0.0, v) - rise * threshold
    carry = eqx.tree_at(lambda c: c.memory, carry, _Trace(carry.memory.field, places))

    def advance(c, now):
        drive, number, v, place, base, rise, along = now
        rhs, trial_at = law.posed(c, drive)
        corner = jax.lax.optimization_barrier(c.memory.places.at[place].get(mode="promise_in_bounds"))
        m = corner[1] + base + rise * corner[0]
        slope, extra = law.p + law.q * along, 0.0
        if law.effects:
            extra = law.extra(c.states, trial_at(v, m))[0]

            def other(x):
                return law.extra(stop_gradient(c.states), stop_gradient_trial(trial_at, x, stop_gradient(m) + along * (x - v)))[0]

            slope = slope + jax.jvp(other, (v,), (jnp.ones_like(v),))[1]
        change = -(law.p * v + law.q * m - rhs + extra) / stop_gradient(slope)
        v, m = v + change, m + along * change
        extra = law.extra(c.states, trial_at(v, m)) if law.effects else (0.0, 0.0, 0.0)
        places = c.memory.places.at[number].add(jnp.stack([v, m]), mode="promise_in_bounds", unique_indices=True)
        return law.after(c, drive, trial_at, v, m, extra, _Trace(v, places), law.p * v + law.q * m + extra[0] - rhs)

    drive = (applied[1:], current[1:], _ends_of_periods(count, period), *(d[1:] for d in disturbance or ()))
    numbers = known + jnp.arange(1, count)
    rows = jax.lax.scan(advance, carry, (drive, numbers, v, place, base, rise, along))[1]
    return tuple(jnp.concatenate([x[None], y]) for x, y in zip(first, rows, strict=True))
