"""The density as the fit sees it: hats on knots in mean field and coercive field, nonnegative, with roughness penalties.

Coordinates s = (alpha + beta)/2 and r = (alpha - beta)/2; knots uniform in s and dense near r = 0 (r = R u^1.6).
One column of cells below every recorded field and one row above are kept apart: their relays switch once and stay, which
lets the level of M depend on a recording's highest and lowest field without asking for the whole past.
"""

import dataclasses
import functools

import jax
import numpy as np

R_EXPONENT = 1.6
TAIL = 0.5
RIDGE = 0.3  # beside second differences
COLUMNS = 114  # unknowns that a program takes at once: none depends on how many there are


def on_device(values):
    """Numbers as a JAX array of floats or complex ones; `jnp.asarray` would compile a program for every new shape."""
    values = np.asarray(values)
    return jax.device_put(values if values.dtype.kind in "fc" else values.astype(float))


@dataclasses.dataclass(frozen=True)
class DensityBasis:
    """masses = total * (cells @ x) on an (L+2) x (L+2) plane whose column 0 and last row hold the once-switching relays.

    `low`, `high`: range of that plane, A/m; `cells`: ((L+2)^2, unknowns), unit-free; `penalties`: one matrix of
    second differences per family (along s, along r, along the once-switching column); `total`: A/m;
    `flat`: the unknowns of a uniform density of mass `total`.
    """

    low: float
    high: float
    size: int
    cells: np.ndarray
    penalties: tuple[np.ndarray, ...]
    total: float
    flat: np.ndarray
    knots_s: int
    knots_r: int
    held: np.ndarray | None = None  # (size, size), A/m: masses that are there beside them, and stay

    @functools.cached_property
    def tables(self) -> np.ndarray:
        """Everett values of every hat at total mass 1, as `magjax.preisach.everett` has them, (unknowns, size + 1, size + 1)."""
        return np.concatenate(self.placed[1])[: self.unknowns]

    @functools.cached_property
    def placed(self) -> tuple:
        """Masses and Everett values of the hats, `COLUMNS` at a time and the last filled up with none, and penalties as JAX
        arrays: every fit on this basis shares them."""
        L, parts = self.size, ([], [])
        for first in range(0, self.unknowns, COLUMNS):
            some = self.cells[:, first : first + COLUMNS].T.reshape(-1, L, L)
            cubes, values = np.zeros((COLUMNS, L, L)), np.zeros((COLUMNS, L + 1, L + 1))
            cubes[: len(some)] = some
            values[:, 1:, :L] = np.cumsum(np.cumsum(cubes, axis=1)[:, :, ::-1], axis=2)[:, :, ::-1]
            k = np.arange(L)
            values[:, k, k + 1] = cubes[:, k, k]
            for part, held in zip(parts, (cubes, values), strict=True):
                part.append(on_device(held))
        return *map(tuple, parts), tuple(on_device(D) for D in self.penalties)

    @property
    def unknowns(self) -> int:
        """How many unknowns the density has."""
        return self.cells.shape[1]

    def masses(self, x) -> np.ndarray:
        """The (L+2, L+2) mass array, A/m."""
        return (self.total * (self.cells @ np.asarray(x))).reshape(self.size, self.size)


@functools.lru_cache(maxsize=2)
def hat_basis(
    low: float,
    high: float,
    total: float,
    level: int = 80,
    knots_s: int = 18,
    knots_r: int = 13,
    crowd: float = 1.0,
    reversible: bool = False,
) -> DensityBasis:
    """Bilinear hats for fields between `low` and `high` (A/m) at level `level`, and the once-switching column.

    `crowd` > 1 gathers the knots in the middle of the plane, where soft materials switch; `reversible` adds hats on the
    diagonal alone: a part without hysteresis, which hats in r can only make as a spike that their penalty resists.
    """
    step = (high - low) / level
    size, refine = level + 2, 4
    points = low + step * (np.arange(level * refine) + 0.5) / refine
    alpha, beta = np.meshgrid(points, points, indexing="ij")
    inside = alpha >= beta
    weight = np.where(inside, 1.0, 0.0)
    weight[np.diag_indices(len(points))] = 0.5
    s, r = 0.5 * (alpha + beta), 0.5 * (alpha - beta)
    even = np.linspace(-1, 1, knots_s)
    s_knots = 0.5 * (low + high) + 0.5 * (high - low) * np.sign(even) * np.abs(even) ** crowd
    r_knots = 0.5 * (high - low) * np.linspace(0, 1, knots_r) ** (R_EXPONENT * crowd**0.5)
    hats_s, hats_r = _hats(s[inside], s_knots), _hats(r[inside], r_knots)
    row, column = (k[inside] // refine for k in np.indices(s.shape))
    cell = (row + 1) * size + (column + 1)
    number, columns = {}, []
    for a in range(knots_s):
        for b in range(knots_r):
            value = hats_s[:, a] * hats_r[:, b] * weight[inside]
            mass = np.bincount(cell, value, size * size)
            if mass.sum() > 1e-3:
                number[a, b] = len(columns)
                columns.append(mass)
    area = sum(c.sum() for c in columns)
    columns = [c / area for c in columns]
    main = len(columns)
    once_knots = np.linspace(low, high, max(6, knots_s // 2))
    once = _hats(low + step * (np.arange(level) + 0.5), once_knots)
    for place in ((slice(1, -1), 0), (-1, slice(1, -1))):
        for k in range(once.shape[1]):
            mass = np.zeros((size, size))
            mass[place] = once[:, k] / level
            columns.append(mass.ravel())
    once_end = len(columns)
    for k in range(knots_s if reversible else 0):
        on_diagonal = np.diag(_hats(low + step * (np.arange(level) + 0.5), s_knots)[:, k] / level)
        columns.append(np.pad(on_diagonal, 1).ravel())
    cells = np.stack(columns, axis=1)
    penalties = [
        _differences(
            [[number.get((a + d, b)) for d in (-1, 0, 1)] for a in range(knots_s) for b in range(knots_r)], cells.shape[1]
        ),
        _differences(
            [[number.get((a, b + d)) for d in (-1, 0, 1)] for a in range(knots_s) for b in range(knots_r)], cells.shape[1]
        ),
        np.concatenate(
            [
                _differences(_triples(main, once.shape[1]) + _triples(main + once.shape[1], once.shape[1]), cells.shape[1]),
                RIDGE
                * _continuation(
                    low, high, once_knots, s_knots, r_knots, number, main, refine**2 * level / (area * step), cells.shape[1]
                ),
            ]
        ),
    ]
    if reversible:
        penalties.append(_differences(_triples(once_end, knots_s), cells.shape[1]))
    flat = np.ones(cells.shape[1])
    flat[main:] = 0.05
    return DensityBasis(low - step, high + step, size, cells, tuple(penalties), total, flat, knots_s, knots_r)


def _continuation(low, high, once_knots, s_knots, r_knots, number, main, scale, unknowns):
    """Rows that hold the once-switching relays to what the density at the edge of the plane lets expect beyond it.

    A tail that falls as the square of the coercive field holds the edge's density times the distance from the diagonal, an
    exponential one less: TAIL is half of it.
    """
    rows = []
    for side, distance in ((0, once_knots - low), (1, high - once_knots)):
        edge = (once_knots + (low, high)[side]) / 2
        hats_s, hats_r = _hats(edge, s_knots), _hats(distance / 2, r_knots)
        for k in range(len(once_knots)):
            row = np.zeros(unknowns)
            row[main + side * len(once_knots) + k] = 1.0
            for (a, b), j in number.items():
                row[j] = -TAIL * distance[k] * scale * hats_s[k, a] * hats_r[k, b]
            rows.append(row)
    return np.stack(rows)


def _hats(x, knots):
    """Linear hat functions on knots, (points, knots)."""
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], axis=1)


def _triples(first, count):
    """Neighbours of a row of `count` unknowns from number `first` on."""
    return [[first + k - 1, first + k, first + k + 1] for k in range(1, count - 1)]


def _differences(triples, unknowns, ridge=()):
    """Rows of second differences for every complete triple of unknowns, and of first for a ridge."""
    rows = []
    for triple in triples:
        if all(k is not None for k in triple):
            row = np.zeros(unknowns)
            row[triple] = (1.0, -2.0, 1.0)
            rows.append(row)
    for k in ridge:
        row = np.zeros(unknowns)
        row[k] = RIDGE
        rows.append(row)
    return np.stack(rows)


def held_basis(hysteresis, total: float) -> DensityBasis:
    """No unknown at all: the masses of an operator as they are."""
    masses = np.asarray(hysteresis.masses)
    none = np.zeros((masses.size, 0))
    return DensityBasis(float(hysteresis.low), float(hysteresis.high), len(masses), none, (), total, np.zeros(0), 0, 0, masses)


@functools.lru_cache(maxsize=2)
def cell_basis(low: float, high: float, total: float, level: int) -> DensityBasis:
    """One unknown a cell, the form of T&B Sec. 2.1, with the once-switching column; penalties along s and r."""
    size = level + 2
    number, columns = {}, []
    area = level * level / 2
    for i in range(level):
        for j in range(i + 1):
            mass = np.zeros((size, size))
            mass[i + 1, j + 1] = (0.5 if i == j else 1.0) / area
            number[i, j] = len(columns)
            columns.append(mass.ravel())
    main = len(columns)
    for column in (True, False):
        for i in range(level):
            mass = np.zeros((size, size))
            mass[(i + 1, 0) if column else (-1, i + 1)] = 1.0 / level
            columns.append(mass.ravel())
    cells = np.stack(columns, axis=1)
    along_s = [[number.get((i + d, j + d)) for d in (-1, 0, 1)] for i in range(level) for j in range(i + 1)]
    along_r = [[number.get((i + d, j - d)) for d in (-1, 0, 1)] for i in range(level) for j in range(i + 1)]
    once = _triples(main, level) + _triples(main + level, level)
    penalties = tuple(
        _differences(t, cells.shape[1], ridge) for t, ridge in ((along_s, ()), (along_r, ()), (once, range(main, cells.shape[1])))
    )
    flat = np.ones(cells.shape[1])
    flat[main:] = 0.05
    step = (high - low) / level
    return DensityBasis(low - step, high + step, size, cells, penalties, total, flat, level, level)
