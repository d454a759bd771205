"""What an effect that is asked for does at its own block, to first order: what it adds to every step of (4), to the drive, or to the
signals behind the march. It depends on none of those that the actuator has; how it reaches the reading is told by `adjoint.Rows`.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from magjax.chain import Timeline
from magjax.chain.coupled import disturbance_of
from magjax.programs import often, seldom
from magjax.simulate import driven_current, finish_chain


def marching(actuator):
    """The actuator with those of its effects that change the field or the magnetization."""
    return dataclasses.replace(actuator, effects=tuple(e for e in actuator.effects if e.marches))


def bare(actuator):
    """The actuator without its effects."""
    return dataclasses.replace(actuator, effects=())


@seldom
def last_period(predictor, actuator, levels, times):
    """Field, magnetization and its spread of the last of `times` periods of the recordings of one grid, (recordings, samples) each;
    `levels`: of their M, A/m."""
    return predictor.march_period(actuator, levels, times, 1)


@often
def in_step_change(effect, predictor, actuator, path, finite: bool):
    """What an effect adds to every step along a path, (relay field, magnetization, current, step) of (recordings, time) each and (recordings,),
    of the predictor's periods on one grid, 3 of (recordings, time): its derivative at null, or, `finite`, all of it."""

    def one(periods, v, M, current, dt):
        def of(effect):
            return disturbance_of(effect, actuator, v, M, current, dt, (len(v) - 1) // periods)

        if finite:
            return of(effect)
        return jax.jvp(lambda a: of(effect.with_amplitude(a)), (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]

    return jax.vmap(functools.partial(one, *predictor.periods))(*path)


@often
def drive_change(effect, predictor, actuator):
    """d drive / d amplitude of a source effect at null, per grid, (recordings, samples)."""

    def one(drive, dt):
        line = Timeline(dt, drive.shape[0], True)
        return jax.jvp(lambda a: effect.with_amplitude(a).drive(drive, line, actuator), (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]

    return tuple(jax.vmap(one)(d, t) for d, t in zip(predictor.drives, predictor.steps, strict=True))


@seldom
def signals_of(predictor, actuator, fields):
    """Every signal of the last period of every recording from its `fields`, per grid: `Signals` of (recordings, samples)."""

    def one(drive, dt, *fields):
        line, zero = Timeline(dt, drive.shape[0], True), jnp.zeros(())
        return finish_chain(actuator, line, drive, driven_current(actuator, drive, line), *fields, fields[0], zero, zero)

    return [jax.vmap(one)(d, t, *f) for d, t, f in zip(predictor.drives, predictor.steps, fields, strict=True)]


def lines_of(predictor, signals) -> np.ndarray:
    """The reading's coefficients, (recordings, harmonics + 1), of `signals_of`."""
    rows = [np.fft.rfft(np.asarray(s.reading))[:, : predictor.harmonics + 1] / s.reading.shape[1] for s in signals]
    return np.concatenate(rows)[np.asarray(predictor.index)]


@often
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
