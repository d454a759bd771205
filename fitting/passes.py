"""The chain and its derivatives by programs that all fits share.

What is compiled knows neither how many recordings there are, nor the density, nor what is free: whole ROWS of recordings go
through at once, and COLUMNS of the unknowns. Once a bench was fitted, the next one, a further recording, finer hats on the
same plane and a parameter of an effect set free ask for nothing that is not there.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np

from magjax.programs import kept

from .columns import marching
from .density import COLUMNS
from .model import MEMORY, Target, whitened
from .solver import pushed


class Point(eqx.Module):
    """Where a program is to stand, or a direction there (a leading axis of columns on each).

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
def _march(template, names, point, predictor):
    return predictor.march(point.actuator(template, names), point.levels)


@kept
def _march_changes(template, names, point, predictor, total, directions):
    """What `_march` gives, and its change along each of the directions; the densities of these at a total mass of 1."""
    marched, push = jax.linearize(lambda p: predictor.march(p.actuator(template, names), p.levels), point)

    def scaled(d):
        return d if d.masses is None else eqx.tree_at(lambda d: (d.masses, d.values), d, (total * d.masses, total * d.values))

    return marched, pushed(lambda d: push(scaled(d)), directions)


@kept
def _read(template, names, parameters, predictor, marched):
    return predictor.lines(template.replace(dict(zip(names, parameters, strict=True))), marched)


@kept
def _read_changes(template, names, parameters, predictor, marched, directions, changes):
    """Change of the lines along each of the directions of the parameters, with the changes of the march."""

    def lines(parameters, marched):
        return predictor.lines(template.replace(dict(zip(names, parameters, strict=True))), marched)

    _, push = jax.linearize(lines, parameters, marched)
    return pushed(lambda d: push(*d), (directions, changes))


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
        planes = ((COLUMNS, size, size) for size in (layout.hats.size, layout.hats.size + 1))
        self.none = (None, None) if self.held is not None else tuple(map(np.zeros, planes))
        self.target = Target(*(np.asarray(getattr(problem.target, f.name)) for f in dataclasses.fields(Target)))
        self.order = np.asarray(problem.predictors[0].index)

    def residual(self, z) -> np.ndarray:
        """The whitened misfit on the fine grid."""
        return whitened(self.lines(z, self.problem.predictors[1]), self.target, np)

    def lines(self, z, predictor) -> np.ndarray:
        """The reading's coefficients by a predictor of the same recordings, (recordings, harmonics + 1)."""
        z = np.asarray(z, float)
        parameters = self.read.at(z)
        lines = [
            np.asarray(_read(self.read.actuator, self.read.names, parameters, part, marched))[: len(places)]
            for part, places, marched in self._marched(z, predictor)
        ]
        return np.concatenate(lines)[self.order]

    def fields(self, z) -> list:
        """Drive, field H and magnetization M of every recording over a period of the fine grid: [(drive, H, M)], (samples,)."""
        rows = [
            tuple(np.asarray(x)[k] for x in (part.drives[0], *marched[0]))
            for part, places, marched in self._marched(np.asarray(z, float), self.problem.predictors[1])
            for k in range(len(places))
        ]
        return [rows[k] for k in self.order]

    def jacobian(self, z) -> np.ndarray:
        """The derivative of the whitened misfit, on the coarse grid."""
        z, predictor = np.asarray(z, float), self.problem.predictors[0]
        parts, point, total = list(predictor.batches()), self._point(z), np.asarray(self.total)
        parameters, rows = self.read.at(z), []
        for first in range(0, len(z), COLUMNS):
            columns = range(first, min(first + COLUMNS, len(z)))
            towards, own = self._directions(z, columns), self.read.slopes(z, columns)
            found = []
            for part, places in parts:
                there, along = self._of(point, z, part, places), self._along(towards, part, places, columns)
                marched, changes = _march_changes(self.march.actuator, self.march.names, there, part, total, along)
                lines = _read_changes(self.read.actuator, self.read.names, parameters, part, marched, own, changes)
                found.append(np.asarray(lines)[: len(columns), : len(places)])
            rows.append(np.concatenate(found, axis=1)[:, self.order])
        still = dataclasses.replace(self.target, lines=np.zeros_like(self.target.lines))
        return whitened(np.concatenate(rows), still, np).T

    def compiling(self, z) -> list:
        """What a fit from z compiles, as calls that do not wait for each other."""
        z = np.asarray(z, float)
        part, places = next(self.problem.predictors[0].batches())
        columns = range(min(COLUMNS, len(z)))
        there = self._of(self._point(z), z, part, places)
        along, own = self._along(self._directions(z, columns), part, places, columns), self.read.slopes(z, columns)
        still = ((np.zeros(part.drives[0].shape),) * 2,)
        none = jax.tree.map(lambda x: np.zeros((COLUMNS, *x.shape)), still)
        return [
            lambda _: self.residual(z),
            lambda _: _march_changes(self.march.actuator, self.march.names, there, part, np.asarray(self.total), along),
            lambda _: _read_changes(self.read.actuator, self.read.names, self.read.at(z), part, still, own, none),
        ]

    def _marched(self, z, predictor):
        point = self._point(z)
        for part, places in predictor.batches():
            yield part, places, _march(self.march.actuator, self.march.names, self._of(point, z, part, places), part)

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

    def _directions(self, z, columns) -> Point:
        """Of each of the unknowns `columns`, COLUMNS in all."""
        layout, part, offset = self.problem.layout, columns[0] // COLUMNS, np.zeros(COLUMNS)
        hats = self.held is None and part < len(self.problem.tables)
        if hats:
            offset += self.total * np.asarray(self.problem.tables[part])[:, -1, 0]
        if layout.density_unknowns in columns:
            offset[layout.density_unknowns - columns[0]] = self.total
        masses, values = (layout.hats.each(columns[0]), self.problem.tables[part]) if hats else self.none
        return Point(masses, values, offset, self.march.slopes(z, columns))

    def _along(self, towards, part, places, columns) -> Point:
        """The directions of a batch: with the levels of its recordings."""
        memories, levels = self.problem.layout.memories, np.zeros((COLUMNS, len(part.index)))
        if memories:
            own = self.problem.layout.size - memories + places - columns[0]
            here = np.flatnonzero((own >= 0) & (own < len(columns)))
            levels[own[here], here] = MEMORY * self.total
        return dataclasses.replace(towards, levels=levels)


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

    def slopes(self, z, columns) -> np.ndarray:
        """Their derivatives by the unknowns `columns`, (COLUMNS, parameters)."""
        found = np.zeros((COLUMNS, len(self.names)))
        rows = self.layout.density_unknowns + 1 + self.free - columns[0]
        here = (rows >= 0) & (rows < len(columns))
        found[rows[here], self.to[here]] = self.layout.parameters(z)[1][self.free][here]
        return found
