"""From unknowns to predicted harmonics: the differentiable half of the fit.

`Layout` orders the flat vector of unknowns: density, the level of M at the bottom of the plane, free physical
parameters in the optimiser's coordinates (log for positive ones). `Predictor` simulates the steady state of every
recording on a period grid and returns the whitened misfit of the reading's harmonics, prior rows below.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from magjax.chain import Timeline
from magjax.chain.coupled import KEPT_FIRST, KEPT_LAST
from magjax.preisach import Preisach
from magjax.programs import kept
from magjax.simulate import driven_current, finish_chain, march_chain, march_period

from .density import DensityBasis, Hats, everett_values, on_device

ROWS, MOST_ROWS = 5, 15  # a program takes whole ROWS of recordings, the last of them repeated, and no more at once
MEMORY = 3e-4  # of the total; prior deviation of each recording's level of M


class Layout(eqx.Module):
    """Order of the unknowns: [density, bottom of M / total, free physical parameters in the optimiser's coordinates,
    level of M of each recording].

    The last carry a tight prior (MEMORY of the total): what the start transient left in relays that later never switch.

    A parameter is start * exp(z) where it must stay positive (`log`), else start + scale * z. `lows` and `highs`: the
    parameters' bounds in SI, infinite where the fit keeps none. The arrays are traced, so that fits of the same shape share
    one compiled program.
    """

    hats: Hats  # of the density's unknowns
    total: jax.Array
    starts: jax.Array
    scales: jax.Array
    lows: jax.Array
    highs: jax.Array
    names: tuple[str, ...] = eqx.field(static=True)
    log: tuple[bool, ...] = eqx.field(static=True)
    density_unknowns: int = eqx.field(static=True)
    memories: int = eqx.field(static=True, default=0)
    held: jax.Array | None = None

    @staticmethod
    def build(basis, names, starts, scales, lows, highs, log, memories: int = 0) -> "Layout":
        """From a density basis and the free parameters' names, start values, scales, bounds and coordinate kinds."""
        return Layout(
            basis.hats, on_device(basis.total),
            on_device(starts), on_device(scales), on_device(lows), on_device(highs), tuple(names), tuple(log), basis.unknowns, memories,
            None if basis.held is None else on_device(basis.held),
        )  # fmt: skip

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.density_unknowns + 1 + len(self.names) + self.memories

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest value of each unknown: masses are not negative, parameters keep what bounds they have."""
        n, starts = self.density_unknowns, np.asarray(self.starts)
        found = []
        for ends, every, masses in ((self.lows, -np.inf, 0.0), (self.highs, np.inf, np.inf)):
            ends = np.asarray(ends)
            bound = np.full(self.size, every)
            bound[:n] = masses
            with np.errstate(divide="ignore", invalid="ignore"):
                own = np.where(np.asarray(self.log, bool), np.log(ends / starts), (ends - starts) / np.asarray(self.scales))
            bound[n + 1 : n + 1 + len(ends)] = np.where(np.isfinite(ends), own, every)
            found.append(bound)
        return found[0], found[1]

    def inside(self, z) -> np.ndarray:
        """Which unknowns are not at a bound."""
        lower, upper = self.bounds
        return (z > lower) & (z < upper)

    def index(self, name: str) -> int:
        """Where a parameter stands in the vector."""
        return self.density_unknowns + 1 + self.names.index(name)

    def value(self, name: str, z):
        """A parameter in SI."""
        k = self.names.index(name)
        z = z[self.density_unknowns + 1 + k]
        return self.starts[k] * jnp.exp(z) if self.log[k] else self.starts[k] + self.scales[k] * z

    def slope(self, name: str, z) -> float:
        """d value / d z."""
        k = self.names.index(name)
        return float(self.value(name, z)) if self.log[k] else float(self.scales[k])

    def parameters(self, z) -> tuple[np.ndarray, np.ndarray]:
        """All of them in SI, and d value / d z of each, in NumPy."""
        starts, scales, log = np.asarray(self.starts), np.asarray(self.scales), np.asarray(self.log, bool)
        n = self.density_unknowns + 1
        y = np.asarray(z)[n : n + len(starts)]
        with np.errstate(over="ignore"):  # of a trial step
            values = np.where(log, starts * np.exp(np.where(log, y, 0.0)), starts + scales * y)
        return values, np.where(log, values, scales)

    def coordinate(self, name: str, value: float) -> float:
        """The optimiser's coordinate of a value in SI."""
        k = self.names.index(name)
        if self.log[k]:
            return float(np.log(value / self.starts[k]))
        return float((value - self.starts[k]) / self.scales[k])

    def levels(self, z):
        """What each recording's start transient adds to M, A/m, (recordings,) or None."""
        return MEMORY * self.total * z[self.size - self.memories :] if self.memories else None

    def masses(self, z):
        """The Preisach masses, A/m, (levels - 1, levels - 1)."""
        if self.held is not None:
            return self.held
        return self.total * self.hats.masses(z[: self.density_unknowns])

    def plane(self, z):
        """Masses and their Everett values at the levels, A/m, in NumPy."""
        masses = float(self.total) * self.hats.masses(np.asarray(z)[: self.density_unknowns])
        return masses, everett_values(masses)

    def actuator(self, template, z):
        """The actuator that the unknowns describe; `template` gives everything that is fixed (pure, differentiable)."""
        masses = self.masses(z)
        offset = self.total * z[self.density_unknowns] + jnp.sum(masses)
        template = eqx.tree_at(lambda a: (a.hysteresis.masses, a.hysteresis.offset), template, (masses, offset))
        values = {name: self.value(name, z) for name in self.names}
        return template.replace(values) if values else template


@dataclasses.dataclass(frozen=True)
class Grid:
    """The recordings that share a period grid: drive samples (recordings, grid), steps (s), periods simulated, place among all."""

    drive: np.ndarray
    dt: np.ndarray
    periods: int
    index: np.ndarray


def period_grids(spectra, samples: int, periods, apart: bool = True) -> tuple[Grid, ...]:
    """Recordings grouped by how fine a grid their drive needs, or on that of the finest where not `apart`, and by their `periods`,
    (recordings,); `samples` points a period of the highest strong line."""
    groups: dict[tuple[int, int], list[int]] = {}
    for k, s in enumerate(spectra):
        power = np.abs(s.drive[1:]) ** 2
        strong = np.flatnonzero(power > 1e-3 * power.max())
        factor = int(2 ** np.ceil(np.log2(max(1, strong.max() + 1) / 1.5))) if strong.max() else 1
        groups.setdefault((samples * min(factor, 8), int(periods[k])), []).append(k)
    groups = groups if apart else {tuple(max(x) for x in zip(*groups, strict=True)): list(range(len(spectra)))}
    grids = []
    for (n, number), members in groups.items():
        drive = np.stack([spectra[k].drive_at(np.arange(n) / n) for k in members])
        dt = np.asarray([1 / (spectra[k].frequency * n) for k in members])
        grids.append(Grid(drive, dt, number, np.asarray(members)))
    return tuple(grids)


class Predictor(eqx.Module):
    """Predicted reading harmonics of all recordings for an actuator: of the last of the `periods` simulated on each grid; of one grid
    `times`, where that is many and no number for the compiler (`for_any`)."""

    drives: tuple[jax.Array, ...]
    steps: tuple[jax.Array, ...]
    index: tuple[int, ...] = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)
    periods: tuple[int, ...] = eqx.field(static=True)
    corners: int = eqx.field(static=True)
    until: tuple[float, int] | None = eqx.field(static=True, default=None)
    times: jax.Array | None = None

    @staticmethod
    def build(spectra, samples: int, harmonics: int, periods, corners: int, apart: bool = True, until=None) -> "Predictor":
        """For spectra on grids of `samples` points a period of the fastest strong line; not `apart`: one program for all of them.
        `periods`: of all, or of each; `until`: (tolerance, most) instead, see `run_chain`."""
        grids = period_grids(spectra, samples, np.broadcast_to(periods, len(spectra)), apart)
        order = np.argsort(np.concatenate([g.index for g in grids]))
        return Predictor(
            tuple(on_device(g.drive) for g in grids), tuple(on_device(g.dt) for g in grids),
            tuple(int(k) for k in order), harmonics, tuple(g.periods for g in grids), corners, until,
        )  # fmt: skip

    @property
    def periods_of_each(self) -> tuple[int, ...]:
        """Periods simulated of every recording."""
        found = np.repeat(self.periods, [len(d) for d in self.drives])[np.asarray(self.index)]
        return tuple(int(n) for n in found)

    def __call__(self, actuator, levels=None):
        """Complex Fourier coefficients 0..harmonics of the reading, (recordings, harmonics + 1).

        `levels`: what is added to M in each recording, A/m, (recordings,).
        """
        return self.lines(actuator, self.march(actuator, levels))

    def march(self, actuator, levels=None):
        """Field, magnetization and its spread of every recording: per grid three of (recordings, samples)."""

        def one(periods, drive, dt, level):
            shifted = eqx.tree_at(lambda a: a.hysteresis.offset, actuator, actuator.hysteresis.offset + level)
            line = Timeline(dt, drive.shape[0], True)
            return march_chain(shifted, line, driven_current(actuator, drive, line), periods, self.corners, until=self.until)[:3]

        order = np.asarray(self.index)
        levels = jnp.zeros(len(order)) if levels is None else levels
        levels = levels[np.argsort(order)]  # as the grids hold the recordings
        parts, at = [], 0
        for drive, dt, periods in zip(self.drives, self.steps, self.periods, strict=True):
            parts.append(jax.vmap(functools.partial(one, periods))(drive, dt, levels[at : at + drive.shape[0]]))
            at += drive.shape[0]
        return tuple(parts)

    def march_period(self, actuator, levels, times, stride):
        """As `march` of one grid, three of (recordings, samples), with numbers that what is compiled does not know: in the last of `times`
        periods, by every `stride`-th sample of it, 0 between."""

        def one(drive, dt, level):
            shifted = eqx.tree_at(lambda a: a.hysteresis.offset, actuator, actuator.hysteresis.offset + level)
            line = Timeline(dt, drive.shape[0], True)
            return march_period(shifted, line, driven_current(actuator, drive, line), times, self.corners, stride)

        return jax.vmap(one)(self.drives[0], self.steps[0], levels)

    def batches(self):
        """The same in parts of whole `ROWS` recordings on one grid, the last repeated: yields (predictor, places of its recordings)."""
        members, at = np.argsort(np.asarray(self.index)), 0
        for drives, steps, periods in zip(self.drives, self.steps, self.periods, strict=True):
            drives, steps = np.asarray(drives), np.asarray(steps)
            rows = -(-len(drives) // ROWS) * ROWS
            rows = rows if rows <= MOST_ROWS else 2 * ROWS
            for first in range(0, len(drives), rows):
                some = np.minimum(np.arange(first, first + rows), len(drives) - 1)
                part = dataclasses.replace(self, drives=(drives[some],), steps=(steps[some],), periods=(periods,), index=tuple(range(rows)))
                yield part, members[at + first : at + min(first + rows, len(drives))]
            at += len(drives)

    def filled(self, rows, axis: int = 0) -> np.ndarray:
        """What belongs to the recordings of one of the `batches`, along an axis, with the last repeated as there."""
        return np.take(rows, np.minimum(np.arange(len(self.index)), rows.shape[axis] - 1), axis)

    def for_any(self) -> "Predictor":
        """The same of one grid with `times` in place of many periods: marches of 8, 14 and 24 share their programs."""
        (periods,) = self.periods
        if periods <= KEPT_FIRST + KEPT_LAST:
            return self
        return dataclasses.replace(self, periods=(KEPT_FIRST + KEPT_LAST,), times=np.asarray(periods))

    def behind(self, corners: int = 0) -> "Predictor":
        """The same for what is behind the march, and does not know how that went; with `corners` for a `march_period`."""
        return dataclasses.replace(self, periods=(1,) * len(self.periods), corners=corners, until=None, times=None)

    def lines_of_each(self, actuators, levels):
        """As `self(actuator, levels)` for several actuators, the leading axis of every array: (actuators, recordings, harmonics + 1).

        Actuators and recordings are one axis: nested ones are no quicker than one actuator after the other.
        """

        def one(periods, actuator, drive, dt, level):
            shifted = eqx.tree_at(lambda a: a.hysteresis.offset, actuator, actuator.hysteresis.offset + level)
            line = Timeline(dt, drive.shape[0], True)
            current = driven_current(actuator, drive, line)
            fields = march_chain(shifted, line, current, periods, self.corners)[:3]
            zero = jnp.zeros(())
            reading = finish_chain(actuator, line, drive, current, *fields, fields[0], zero, zero).reading
            return jnp.fft.rfft(reading)[: self.harmonics + 1] / drive.shape[0]

        number, order = jax.tree.leaves(actuators)[0].shape[0], np.asarray(self.index)
        levels = (jnp.zeros((number, len(order))) if levels is None else levels)[:, np.argsort(order)]
        parts, at = [], 0
        for drive, dt, periods in zip(self.drives, self.steps, self.periods, strict=True):
            count = drive.shape[0]
            rows = jax.tree.map(lambda x, count=count: jnp.repeat(x, count, axis=0), actuators)
            own = levels[:, at : at + count].ravel()
            found = jax.vmap(functools.partial(one, periods))(rows, jnp.tile(drive, (number, 1)), jnp.tile(dt, number), own)
            parts.append(found.reshape(number, count, -1))
            at += count
        return jnp.concatenate(parts, axis=1)[:, order]

    def lines(self, actuator, marched):
        """The reading's coefficients from what `march` gave: the blocks behind the hysteresis."""

        def one(drive, dt, *fields):
            line = Timeline(dt, drive.shape[0], True)
            zero = jnp.zeros(())
            signals = finish_chain(actuator, line, drive, driven_current(actuator, drive, line), *fields, fields[0], zero, zero)
            return jnp.fft.rfft(signals.reading)[: self.harmonics + 1] / drive.shape[0]

        parts = [jax.vmap(one)(d, t, *fields) for d, t, fields in zip(self.drives, self.steps, marched, strict=True)]
        return jnp.concatenate(parts)[np.asarray(self.index)]


@kept
def predicted_lines(predictor: Predictor, actuator):
    """`predictor(actuator)` compiled: (recordings, harmonics + 1), complex."""
    return predictor(actuator)


class Target(eqx.Module):
    """What the predictor must meet: measured lines, their deviations, and the prior's weights."""

    lines: jax.Array  # (recordings, harmonics + 1) complex
    deviations: jax.Array  # (recordings, harmonics + 1), inf where a line is not measured
    weights: jax.Array  # one per penalty family
    priors: jax.Array  # 1 / standard deviation in optimiser units per coordinate, 0 where free
    bottom_prior: jax.Array
    gain_rows: jax.Array  # (recordings, harmonics + 1) complex, unit direction of each whitened reading
    gain_shares: jax.Array  # (recordings, recordings), what uncertain scales take off the misfits along them


def whitened(lines, target: Target, xp=jnp):
    """Real residual vector of complex lines: (model - measured) / deviation, mean lines real, uncertain scales taken off.

    `lines`: (..., recordings, harmonics + 1); `xp`: jax.numpy, or numpy with a target of its arrays.
    """
    misfit = (lines - target.lines) / target.deviations
    along = xp.sum((xp.conj(target.gain_rows) * misfit).real, axis=-1)
    misfit = misfit - (along @ target.gain_shares.T)[..., None] * target.gain_rows
    return xp.concatenate([part.reshape(*part.shape[:-2], -1) for part in (misfit.real, misfit[..., 1:].imag)], axis=-1)


def make_start_actuator(template, basis: DensityBasis, rest=None):
    """`template` with a plane that fits the basis (uniform masses)."""
    hysteresis = Preisach(basis.masses(basis.flat), basis.low, basis.high, 0.0, rest=rest)
    return eqx.tree_at(lambda a: a.hysteresis, template, hysteresis)
