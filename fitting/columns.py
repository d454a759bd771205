"""How small changes inside the chain reach the reading, to first order: what the screening and the learned terms share.

Two linear maps, each compiled for what it depends on and no more: from what is added to every step of (4), or to the drive, to the
field and the magnetization (effects before the magnetostriction), and from changes of signals to the reading's lines (all
effects). What an effect that is asked for does at its own block depends on none of those that the actuator has.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from magjax.chain import Timeline
from magjax.chain.coupled import disturbance_of
from magjax.chain.march import magnetize
from magjax.effects.base import AbstractEffect
from magjax.programs import kept
from magjax.simulate import driven_current, finish_chain

AT_ONCE = 8  # columns pushed through a map side by side


def marching(actuator):
    """The actuator with those of its effects that change the field or the magnetization."""
    return dataclasses.replace(actuator, effects=tuple(e for e in actuator.effects if e.marches))


def bare(actuator):
    """The actuator without its effects."""
    return dataclasses.replace(actuator, effects=())


def _march(predictor, actuator, drive, dt, added=None, change=None):
    """(4) over all periods that the predictor runs: field, magnetization and current of the last one; relay field, magnetization and
    current of all."""
    current = driven_current(actuator, drive, Timeline(dt, drive.shape[0], True))
    if change is not None:
        current = current + change
    memory = actuator.hysteresis.memory(actuator.hysteresis.table(), predictor.corners)
    whole = [jnp.append(jnp.tile(x, predictor.periods), x[:1]) for x in (actuator.coil.applied_field(current), current)]
    count = len(current)
    H, M, v, _, _ = magnetize(actuator, *whole, dt, memory, actuator.coil.scheme, added, count)
    unreached = actuator.hysteresis.unreached(jnp.max(v[-count:]), jnp.min(v[-count:]))
    last = (H[-count - 1 : -1], M[-count - 1 : -1] + unreached, current)
    return last, (v, M, whole[1])


@kept
def trajectory(predictor, actuator):
    """The march of every recording, per grid: (field, magnetization) of the last period, (recordings, samples), and (relay field,
    magnetization, coil current, step) of all periods, (recordings, time)."""

    def one(drive, dt):
        (H, M, _), whole = _march(predictor, actuator, drive, dt)
        return (H, M), (*whole, dt)

    rows = [jax.vmap(one)(d, t) for d, t in zip(predictor.drives, predictor.steps, strict=True)]
    return [row[0] for row in rows], [row[1] for row in rows]


@kept
def in_step_change(effect, predictor, actuator, path, finite: bool):
    """What an effect adds to every step along a `trajectory`, 3 of (recordings, time) per grid: its derivative at null, or, `finite`,
    all of it."""

    def one(v, M, current, dt):
        def of(effect):
            return disturbance_of(effect, actuator, v, M, current, dt, (len(v) - 1) // predictor.periods)

        if finite:
            return of(effect)
        return jax.jvp(lambda a: of(effect.with_amplitude(a)), (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]

    return tuple(jax.vmap(one)(*part) for part in path)


@kept
def drive_change(effect, predictor, actuator):
    """d drive / d amplitude of a source effect at null, per grid, (recordings, samples)."""

    def one(drive, dt):
        line = Timeline(dt, drive.shape[0], True)
        return jax.jvp(lambda a: effect.with_amplitude(a).drive(drive, line, actuator), (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]

    return tuple(jax.vmap(one)(d, t) for d, t in zip(predictor.drives, predictor.steps, strict=True))


@kept
def through_march(predictor, actuator, added, changes):
    """First-order change of field, magnetization and current, per grid, (columns, recordings, samples) each.

    `added`: to every step, per grid 3 of (columns, recordings, time), see `magnetize`; `changes`: of the current, per grid,
    (columns, recordings, samples).
    """

    def fields_of(added, changes):
        grids = zip(predictor.drives, predictor.steps, added, changes, strict=True)
        return tuple(jax.vmap(lambda *given: _march(predictor, actuator, *given)[0])(*g) for g in grids)

    origin = jax.tree.map(lambda x: jnp.zeros(x.shape[1:]), (added, changes))
    _, push = jax.linearize(fields_of, *origin)
    return jax.lax.map(lambda d: push(*d), (added, changes), batch_size=AT_ONCE)


@kept
def signals_of(predictor, actuator, fields):
    """Every signal of the last period of every recording from its `fields`, per grid: `Signals` of (recordings, samples)."""

    def one(drive, dt, H, M):
        line, zero = Timeline(dt, drive.shape[0], True), jnp.zeros(())
        return finish_chain(actuator, line, drive, driven_current(actuator, drive, line), H, M, H, zero, zero)

    return [jax.vmap(one)(d, t, *f) for d, t, f in zip(predictor.drives, predictor.steps, fields, strict=True)]


def lines_of(predictor, signals) -> np.ndarray:
    """The reading's coefficients, (recordings, harmonics + 1), of `signals_of`."""
    rows = [np.fft.rfft(np.asarray(s.reading))[:, : predictor.harmonics + 1] / s.reading.shape[1] for s in signals]
    return np.concatenate(rows)[np.asarray(predictor.index)]


@kept
def late_change(effects, predictor, actuator, signals):
    """d (free displacement, displacement, reading) / d amplitude of an effect behind the hysteresis at null, where it acts, per grid,
    (shapes, recordings, samples) each. `effects`: one with its shapes stacked; `signals`: of `signals_of`."""

    def one(effect, s, dt):
        line = Timeline(dt, s.current.shape[0], True)
        known = {
            "command": s.command,
            "current": s.current,
            "field": s.field,
            "magnetization": s.magnetization,
            "flux_density": s.flux_density,
        }

        def of(a):
            e, free, moved = effect.with_amplitude(a), s.free_displacement, s.displacement
            if free is not None:
                free = e.strain(free, s.magnetization, s.field, line, actuator)
            if actuator.mechanics is not None:
                moved = e.displacement(moved, s.free_displacement, known, line, actuator)
            return free, moved, e.reading(s.reading, {**known, "displacement": s.displacement}, line, actuator)

        found = jax.jvp(of, (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]
        return tuple(jnp.zeros_like(s.reading) if d is None else d for d in found)

    over = jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, None))
    return tuple(over(effects, s, dt) for s, dt in zip(signals, predictor.steps, strict=True))


class _Added(AbstractEffect):
    """Signals added behind the hysteresis, (time,): to the free displacement, the displacement, the reading."""

    free: jax.Array
    moved: jax.Array
    read: jax.Array

    def strain(self, free_displacement, magnetization, field, line, actuator):
        return free_displacement + self.free

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        return displacement + self.moved

    def reading(self, reading, signals, line, actuator):
        return reading + self.read


@kept
def to_lines(predictor, actuator, fields, changes, late):
    """First-order change of the reading's lines by changes of signals, (columns, recordings, harmonics + 1).

    `fields`: of `trajectory`. Per grid, `changes`: of field, magnetization, current, or None; `late`: of free displacement, displacement,
    reading; (columns, recordings, samples) each.
    """

    def lines(changes, late):
        def one(drive, dt, given, change, late):
            line, zero = Timeline(dt, drive.shape[0], True), jnp.zeros(())
            H, M, current = (*given, driven_current(actuator, drive, line))
            if change is not None:
                H, M, current = H + change[0], M + change[1], current + change[2]
            changed = dataclasses.replace(actuator, effects=(*actuator.effects, _Added(*late)))
            s = finish_chain(changed, line, drive, current, H, M, H, zero, zero)
            return jnp.fft.rfft(s.reading)[: predictor.harmonics + 1] / drive.shape[0]

        changes = [None] * len(late) if changes is None else changes
        grids = zip(predictor.drives, predictor.steps, fields, changes, late, strict=True)
        return jnp.concatenate([jax.vmap(one)(*g) for g in grids])[np.asarray(predictor.index)]

    origin = jax.tree.map(lambda x: jnp.zeros(x.shape[1:]), (changes, late))
    _, push = jax.linearize(lines, *origin)
    return jax.lax.map(lambda d: push(*d), (changes, late), batch_size=AT_ONCE)
