"""The chain and its derivatives by programs that all fits share.

What is compiled knows neither how many recordings there are, nor the density, nor what is free: whole ROWS of recordings go
through at once, and their lines are led back (`adjoint`). Once a bench was fitted, the next one, a further recording, finer hats on
the same plane and a parameter of an effect set free ask for nothing that is not there.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np

from magjax.programs import kept

from .adjoint import as_lines, marched_steps, read_rows, rows_of
from .columns import marching
from .model import MEMORY, Target, whitened


class Point(eqx.Module):
    """Where a program is to stand.

    `masses`: A/m, (L, L), with their Everett `values`, A/m, (L + 1, L + 1), None where they are held; `offset`: of M, A/m;
    `parameters`: SI, in the order of the names beside it; `levels`: added to M, A/m, (recordings,).
    """

    masses: jax.Array | None
    values: jax.Array | None
    offset: jax.Array
    parameters: jax.Array
    levels: jax.Array | None = None

    def actuator(self, template, names):
        """The template at this point."""
        made = eqx.tree_at(lambda a: a.hysteresis.offset, template, self.offset)
        if self.masses is not None:
            made = eqx.tree_at(lambda a: a.hysteresis, made, made.hysteresis.with_values(self.values, self.masses))
        return made.replace(dict(zip(names, self.parameters, strict=True)))


@kept
def _march(template, names, point, predictor, times, stride):
    return predictor.march_period(point.actuator(template, names), point.levels, times, stride)


@kept
def _read(template, names, parameters, predictor, marched):
    return predictor.lines(template.replace(dict(zip(names, parameters, strict=True))), marched)


class Passes:
    """A problem's residual and Jacobian, (data,) and (data, unknowns), at any of its unknowns."""

    def __init__(self, problem):
        self.problem, layout, template = problem, problem.layout, problem.template
        behind = {f"effects.{e.name}" for e in template.effects if not e.marches}
        own = [f"effects.{e.name}.{n}" for e in template.effects for n in e.parameters()]
        free = [n for n in layout.names if n not in own]
        moving = sorted(n for n in (*free, *own) if n.rpartition(".")[0] not in behind and not n.startswith("sensor."))
        self.march = _Template(marching(template), tuple(moving), layout)
        self.read = _Template(template, tuple(sorted((*free, *own))), layout)
        self.total, self.held = float(layout.total), None if layout.held is None else float(np.sum(layout.held))
        self.target = Target(*(np.asarray(getattr(problem.target, f.name)) for f in dataclasses.fields(Target)))
        self.order = np.asarray(problem.predictors[0].index)
        coarse, fine = (p.drives[0].shape[1] for p in problem.predictors)
        # the most samples of the fine grid that a march may take at once and be no coarser than the Jacobian's
        self.stride = max(d for d in range(1, max(fine // coarse, 1) + 1) if fine % d == 0)

    def residual(self, z, stride: int = 1) -> np.ndarray:
        """The whitened misfit on the fine grid, marched by every `stride`-th sample of it."""
        return whitened(self.lines(z, self.problem.predictors[1], stride), self.target, np)

    def lines(self, z, predictor, stride: int = 1) -> np.ndarray:
        """The reading's coefficients by a predictor of the same recordings, (recordings, harmonics + 1); `stride` as of `residual`."""
        z = np.asarray(z, float)
        parameters = self.read.at(z)
        lines = [
            np.asarray(_read(self.read.actuator, self.read.names, parameters, part.behind(), marched))[: len(places)]
            for part, places, marched in self._marched(z, predictor, stride)
        ]
        return np.concatenate(lines)[self.order]

    def change(self, lines) -> np.ndarray:
        """What changes of the lines, (..., recordings, harmonics + 1), change of the whitened misfit, (..., data)."""
        return whitened(lines, dataclasses.replace(self.target, lines=np.zeros_like(self.target.lines)), np)

    def fields(self, z) -> list:
        """Drive, field H and magnetization M of every recording over a period of the fine grid: [(drive, H, M)], (samples,)."""
        rows = [
            tuple(np.asarray(x)[k] for x in (part.drives[0], *marched[0][:2]))
            for part, places, marched in self._marched(np.asarray(z, float), self.problem.predictors[1])
            for k in range(len(places))
        ]
        return [rows[k] for k in self.order]

    def magnetizations(self, z):
        """Magnetization of every recording over the periods of the coarse grid, of many the first two and the last three, A/m: [(periods, samples)]."""
        z, predictor, found = np.asarray(z, float), self.problem.predictors[0], []
        point = self._point(z)
        for part, places in predictor.batches():
            steps = self._steps(point, z, part, places).steps
            found += list(np.asarray(steps.magnetization)[: len(places), 1:].reshape(len(places), -1, part.drives[0].shape[1]))
        return [found[k] for k in self.order]

    def jacobian(self, z) -> np.ndarray:
        """The derivative of the whitened misfit, on the coarse grid."""
        z, layout, rows = np.asarray(z, float), self.problem.layout, []
        slopes, n = layout.parameters(z)[1], layout.density_unknowns
        rest, total = float(self.problem.template.hysteresis.rest), float(layout.total)
        gained = self.problem.basis.cells.sum(axis=0)  # by each hat, of the sum of the masses, of which it is a share
        gained = gained / max(float(gained @ z[:n]), 1e-300) if self.held is None else None
        for _, places, found in self.rows(z):
            own = np.zeros((*found.mean.shape, len(z)))
            moving = found.by_moving()
            if self.held is None:
                own[..., :n] = total * found.by_density(self.problem.basis, rest) + moving[..., -1:] * gained
            own[..., n] = total * found.known[..., 0]
            for part, by in ((self.march, moving), (self.read, found.read)):
                own[..., n + 1 + part.free] += by[..., part.to] * slopes[part.free]
            for k, place in enumerate(places if layout.memories else ()):
                own[k, :, len(z) - layout.memories + place] = MEMORY * total * found.known[k, :, 0]
            rows.append(own)
        lines = as_lines(np.moveaxis(np.concatenate(rows)[self.order], 2, 0))
        return self.change(lines).T

    def rows(self, z):
        """What every line asks of its march and of what is read, on the coarse grid: yields (part of the predictor, places of
        its recordings, `Rows`)."""
        z, predictor = np.asarray(z, float), self.problem.predictors[0]
        point = self._point(z)
        for part, places in predictor.batches():
            marched = self._steps(point, z, part, places)
            read = self.read_rows(z, part, (marched.field, marched.magnetization, marched.spread))
            number = len(places)  # the last is repeated
            yield part, places, rows_of(*(jax.tree.map(lambda x, n=number: np.asarray(x)[:n], k) for k in (marched, *read)))

    def read_rows(self, z, part, marched):
        """The lines of a part of the recordings by the signals behind the march, and by parameters there: see `adjoint.read_rows`."""
        return read_rows(self.read.actuator, self.read.names, self.read.at(np.asarray(z, float)), part.behind(), marched)

    def compiling(self, z) -> list:
        """What a fit from z compiles, as calls that do not wait for each other."""
        z = np.asarray(z, float)
        part, places = next(self.problem.predictors[0].batches())
        point, still = self._point(z), np.zeros(part.drives[0].shape)
        return [
            lambda _: self.residual(z),
            lambda _: self._steps(point, z, part, places),
            lambda _: self.read_rows(z, part, (still, still, still)),
        ]

    def _steps(self, point, z, part, places):
        return marched_steps(self.march.actuator, self.march.names, self._of(point, z, part, places), part.for_any())

    def _marched(self, z, predictor, stride: int = 1):
        """Yields (part of the predictor, places of its recordings, their last period as `Predictor.lines` asks for it)."""
        point = self._point(z)
        for part, places in predictor.batches():
            own, numbers = self._of(point, z, part, places), (np.asarray(part.periods[0]), np.asarray(stride))
            marched = _march(self.march.actuator, self.march.names, own, part.behind(part.corners), *numbers)
            yield part, places, (tuple(_between(x, stride) for x in marched),)

    def _point(self, z) -> Point:
        n = self.problem.layout.density_unknowns
        if self.held is not None:
            return Point(None, None, np.asarray(self.total * z[n] + self.held), self.march.at(z))
        masses, values = self.problem.layout.plane(z)
        return Point(masses, values, np.asarray(self.total * z[n] + values[-1, 0]), self.march.at(z))

    def _of(self, point, z, part, places) -> Point:
        """The point of a batch: with the levels of its recordings."""
        memories, levels = self.problem.layout.memories, np.zeros(len(part.index))
        if memories:
            levels[: len(places)] = MEMORY * self.total * z[len(z) - memories :][places]
        return dataclasses.replace(point, levels=levels)


def _between(signals, stride: int):
    """Signals of a period, (recordings, samples), of which every `stride`-th sample is known, at all of them: their Fourier series."""
    if stride == 1:
        return signals
    known = np.asarray(signals)[:, ::stride]
    series = np.fft.rfft(known)
    if known.shape[1] % 2 == 0:
        series[:, -1] *= 0.5  # the line at half the sampling stands for two
    return stride * np.fft.irfft(series, signals.shape[1])


class _Template:
    """An actuator and the parameters of it that a program is given, SI: of all effects, free or not, and what else is free."""

    def __init__(self, actuator, names, layout):
        self.actuator, self.names, self.layout, known = actuator, names, layout, actuator.parameters()
        self.values = np.asarray([float(known[n][0]) for n in names])
        self.free = np.asarray([k for k, n in enumerate(layout.names) if n in names], int)  # among those of the layout,
        self.to = np.asarray([names.index(layout.names[k]) for k in self.free], int)  # and where they stand here

    def at(self, z) -> np.ndarray:
        """Their values."""
        values = self.values.copy()
        values[self.to] = self.layout.parameters(z)[0][self.free]
        return values
