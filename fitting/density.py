"""The density as the fit sees it: hats on knots in mean field and coercive field, nonnegative, with roughness penalties.

Coordinates s = (alpha + beta)/2 and r = (alpha - beta)/2; knots uniform in s and dense near r = 0 (r = R u^1.6).
One column of cells below every recorded field and one row above are kept apart: their relays switch once and stay, which
lets the level of M depend on a recording's highest and lowest field without asking for the whole past.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csc_array, csr_array, hstack, vstack

from magjax.errors import ConfigurationError

from .solver import bounded_minimum

R_EXPONENT = 1.6
TAIL = 0.5
RIDGE = 0.3  # beside second differences
SAME_PLANE = 0.02  # of a plane, by which its ends may move before what was found of its density is of another
NEAREST = 1e-6  # of what a density weighs, that its penalties do where it is led over from another basis
AT_ONCE = 100  # unknowns whose planes are in memory side by side


def on_device(values):
    """Numbers as a JAX array of floats or complex ones; `jnp.asarray` would compile a program for every new shape."""
    values = np.asarray(values)
    return jax.device_put(values if values.dtype.kind in "fc" else values.astype(float))


class Hats(eqx.Module):
    """What every unknown of a density puts into which cell of a plane, at a total mass of 1.

    `shares`: (entries,), sorted by the `unknowns` that they belong to; `places`: cells, row by row of a (`size`, `size`) plane.
    """

    shares: jax.Array
    places: jax.Array
    unknowns: jax.Array
    size: int = eqx.field(static=True)

    def masses(self, x):
        """Masses of the unknowns x, (size, size)."""
        if isinstance(x, np.ndarray):
            shares, places, unknowns = (np.asarray(k) for k in (self.shares, self.places, self.unknowns))
            return np.bincount(places, shares * x[unknowns], self.size**2).reshape(self.size, self.size)
        flat = jnp.zeros(self.size**2).at[self.places].add(self.shares * x[self.unknowns])
        return flat.reshape(self.size, self.size)

    def each(self, first: int, count: int) -> np.ndarray:
        """Masses of so many unknowns from number `first` on, (count, size, size)."""
        shares, places, unknowns = (np.asarray(k) for k in (self.shares, self.places, self.unknowns))
        mine = slice(*np.searchsorted(unknowns, (first, first + count)))
        cubes = np.zeros((count, self.size**2))
        cubes[unknowns[mine] - first, places[mine]] = shares[mine]
        return cubes.reshape(count, self.size, self.size)


def everett_values(masses: np.ndarray) -> np.ndarray:
    """Everett values at the levels, as `magjax.preisach.everett` has them, of masses (..., L, L): (..., L + 1, L + 1)."""
    L = masses.shape[-1]
    values, k = np.zeros((*masses.shape[:-2], L + 1, L + 1)), np.arange(L)
    values[..., 1:, :L] = np.cumsum(np.cumsum(masses, axis=-2)[..., ::-1], axis=-1)[..., ::-1]
    values[..., k, k + 1] = masses[..., k, k]
    return values


@dataclasses.dataclass(frozen=True)
class DensityBasis:
    """masses = total * (cells @ x) on an (L+2) x (L+2) plane whose column 0 and last row hold the once-switching relays.

    `low`, `high`: range of that plane, A/m; `cells`: sparse, ((L+2)^2, unknowns), unit-free; `penalties`: one sparse matrix of
    second differences per family (along s, along r, along the once-switching column); `total`: A/m;
    `flat`: the unknowns of a uniform density of mass `total`.
    """

    low: float
    high: float
    size: int
    cells: csc_array
    penalties: tuple[csr_array, ...]
    total: float
    flat: np.ndarray
    knots_s: int
    knots_r: int
    held: np.ndarray | None = None  # (size, size), A/m: masses that are there beside them, and stay

    @functools.cached_property
    def hats(self) -> Hats:
        """The unknowns as programs and `Layout` have them."""
        entries = self.cells.tocoo()
        places, unknowns = (jax.device_put(k.astype(np.int32)) for k in entries.coords)
        return Hats(on_device(entries.data), places, unknowns, self.size)

    @functools.cached_property
    def values(self) -> np.ndarray:
        """Everett values of every unknown at a total mass of 1, (levels^2, unknowns): every fit on this basis shares them."""
        found = np.empty(((self.size + 1) ** 2, self.unknowns))
        for first in range(0, self.unknowns, AT_ONCE):
            count = min(AT_ONCE, self.unknowns - first)
            found[:, first : first + count] = everett_values(self.hats.each(first, count)).reshape(count, -1).T
        return found

    def everett(self, alpha, beta) -> np.ndarray:
        """T(alpha, beta) of every unknown at a total mass of 1, (points, unknowns), as `EverettTable` has it."""
        L = self.size
        step = (self.high - self.low) / L

        def locate(field):
            place = np.clip((np.asarray(field) - self.low) / step, 0, L)
            cell = np.clip(np.floor(np.nan_to_num(place)), 0, L - 1).astype(np.int64)  # of NaN any: its share is NaN
            return cell, place - cell

        (i, p), (j, q), width = locate(alpha), locate(beta), L + 1
        corner = i * width + j
        places = np.stack([corner, corner + 1, corner + width, corner + width + 1, i * width + i + 1, j * width + j + 1], axis=1)
        shares = np.stack([(1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q, -p * (1 - p), -q * (1 - q)], axis=1)
        rows = csr_array((shares.ravel(), places.ravel(), np.arange(0, shares.size + 1, 6)), (len(shares), width**2))
        return rows @ self.values

    @property
    def unknowns(self) -> int:
        """How many unknowns the density has."""
        return self.cells.shape[1]

    def masses(self, x) -> np.ndarray:
        """The (L+2, L+2) mass array, A/m."""
        return (self.total * (self.cells @ np.asarray(x))).reshape(self.size, self.size)

    def on_plane_of(self, other) -> bool:
        """Whether its plane is nearly that of something else with a `low` and a `high`."""
        return abs(self.low - other.low) + abs(self.high - other.high) < SAME_PLANE * (other.high - other.low)

    def taking(self, x, other: "DensityBasis") -> np.ndarray | None:
        """The unknowns whose masses come nearest, in least squares, to those that x makes on another basis; None of another plane.

        What they leave open, as at the edges of the plane, is as smooth as the penalties ask for.
        """
        if not self.on_plane_of(other) or self.size != other.size:
            return None
        if (self.knots_s, self.knots_r, self.unknowns) == (other.knots_s, other.knots_r, other.unknowns):
            return np.asarray(x)
        normal = (self.cells.T @ self.cells).toarray()
        light = NEAREST * np.trace(normal) / len(normal)
        for D in self.penalties:
            normal += light * (D.T @ D).toarray()
        none = np.zeros(self.unknowns)
        return bounded_minimum(normal, -(self.cells.T @ (other.cells @ np.asarray(x))), none, (none, none + np.inf))


@functools.lru_cache(maxsize=2)
def hat_basis(
    low: float,
    high: float,
    total: float,
    level: int = 120,
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
    row, column = (k[inside] // refine for k in np.indices(s.shape))
    cell = (row + 1) * size + (column + 1)
    pairs = [
        (weight[inside] * share_s * share_r, (cell, at_s * knots_r + at_r))
        for at_s, share_s in _neighbours(s[inside], s_knots)
        for at_r, share_r in _neighbours(r[inside], r_knots)
    ]
    shares, places = np.concatenate([v for v, _ in pairs]), np.concatenate([at for _, at in pairs], axis=1)
    every = csc_array((shares, places), (size * size, knots_s * knots_r))  # of every pair of knots
    there = np.flatnonzero(every.sum(axis=0) > 1e-3)
    number = {divmod(int(pair), knots_r): k for k, pair in enumerate(there)}
    every = every[:, there]
    area, main = every.sum(), len(there)
    columns = [every / area]
    once_knots = np.linspace(low, high, max(6, knots_s // 2))
    once = _hats(low + step * (np.arange(level) + 0.5), once_knots)
    for place in ((slice(1, -1), 0), (-1, slice(1, -1))):
        for k in range(once.shape[1]):
            mass = np.zeros((size, size))
            mass[place] = once[:, k] / level
            columns.append(csc_array(mass.reshape(-1, 1)))
    once_end = main + len(columns) - 1
    for k in range(knots_s if reversible else 0):
        on_diagonal = np.diag(_hats(low + step * (np.arange(level) + 0.5), s_knots)[:, k] / level)
        columns.append(csc_array(np.pad(on_diagonal, 1).reshape(-1, 1)))
    cells = hstack(columns, format="csc")
    penalties = [
        _differences(
            [[number.get((a + d, b)) for d in (-1, 0, 1)] for a in range(knots_s) for b in range(knots_r)], cells.shape[1]
        ),
        _differences(
            [[number.get((a, b + d)) for d in (-1, 0, 1)] for a in range(knots_s) for b in range(knots_r)], cells.shape[1]
        ),
        vstack(
            [
                _differences(_triples(main, once.shape[1]) + _triples(main + once.shape[1], once.shape[1]), cells.shape[1]),
                RIDGE
                * _continuation(
                    low, high, once_knots, s_knots, r_knots, number, main, refine**2 * level / (area * step), cells.shape[1]
                ),
            ],
            format="csr",
        ),
    ]
    if reversible:
        penalties.append(_differences(_triples(once_end, knots_s), cells.shape[1]))
    flat = np.ones(cells.shape[1])
    flat[main:] = 0.05
    return DensityBasis(low - step, high + step, size, cells, tuple(penalties), total, flat, knots_s, knots_r)


@dataclasses.dataclass(frozen=True, eq=False)
class Stiffness:
    """How much each difference of a density weighs, where not all of a family weigh the same: `weights` of the families times
    `factors` of their rows, of a density with `knots` between the fields `low` and `high`."""

    weights: np.ndarray
    factors: tuple[np.ndarray, ...]
    knots: tuple[int, int]
    low: float
    high: float

    def fits(self, basis: DensityBasis) -> bool:
        """Whether it is of this density, on nearly this plane."""
        rows = tuple(D.shape[0] for D in basis.penalties)
        return basis.on_plane_of(self) and self.knots == (basis.knots_s, basis.knots_r) and rows == tuple(len(f) for f in self.factors)

    def of(self, penalties) -> tuple[csr_array, ...]:
        """The differences times the roots of their weights."""
        roots = [np.sqrt(w * f) for w, f in zip(self.weights, self.factors, strict=True)]
        return tuple(csr_array(D.multiply(root[:, None])) for root, D in zip(roots, penalties, strict=True))


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
    return csr_array(np.stack(rows))


def _neighbours(x, knots):
    """The two knots about each x within them, as (numbers, shares of the linear hats there)."""
    first = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    share = np.clip((x - knots[first]) / (knots[first + 1] - knots[first]), 0.0, 1.0)
    return (first, 1 - share), (first + 1, share)


def _hats(x, knots):
    """Linear hat functions on knots, (points, knots)."""
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], axis=1)


def _triples(first, count):
    """Neighbours of a row of `count` unknowns from number `first` on."""
    return [[first + k - 1, first + k, first + k + 1] for k in range(1, count - 1)]


def _differences(triples, unknowns, ridge=()):
    """Rows of second differences for every complete triple of unknowns, and a small one for each unknown of a ridge."""
    whole = [t for t in triples if None not in t]
    values = np.append(np.tile((1.0, -2.0, 1.0), len(whole)), np.full(len(ridge), RIDGE))
    columns = np.append(np.asarray(whole, int).ravel(), np.asarray(ridge, int))
    rows = np.append(np.repeat(np.arange(len(whole)), 3), len(whole) + np.arange(len(ridge)))
    return csr_array((values, (rows, columns)), (len(whole) + len(ridge), unknowns))


def held_basis(hysteresis, total: float) -> DensityBasis:
    """No unknown at all: the masses of an operator as they are."""
    masses = np.asarray(hysteresis.masses)
    none = csc_array((masses.size, 0))
    return DensityBasis(float(hysteresis.low), float(hysteresis.high), len(masses), none, (), total, np.zeros(0), 0, 0, masses)


@functools.lru_cache(maxsize=2)
def cell_basis(low: float, high: float, total: float, level: int, number: int | None = None) -> DensityBasis:
    """One unknown a cell, the form of T&B Sec. 2.1, with the once-switching column; penalties along s and r.

    `number` of cells along the plane, a divisor of `level`, which it is where None: each is so many of the level's in a square.
    """
    number = level if number is None else number
    if level % number:
        raise ConfigurationError(f"cells = {number} does not divide the plane's {level} levels; take a divisor, or set level to a multiple")
    size, side, main = level + 2, level // number, number * (number + 1) // 2
    area = level * level / 2
    i, j = np.tril_indices(level)
    at = i // side * (i // side + 1) // 2 + j // side
    edge = np.arange(level)
    rows = np.concatenate([(i + 1) * size + j + 1, (edge + 1) * size, (size - 1) * size + edge + 1])
    columns = np.concatenate([at, main + edge // side, main + number + edge // side])
    shares = np.concatenate([np.where(i == j, 0.5, 1.0) / area, np.full(2 * level, 1.0 / level)])
    cells = csc_array((shares, (rows, columns)), (size * size, main + 2 * number))
    own = {pair: k for k, pair in enumerate(zip(*np.tril_indices(number), strict=True))}
    along_s = [[own.get((i + d, j + d)) for d in (-1, 0, 1)] for i, j in own]
    along_r = [[own.get((i + d, j - d)) for d in (-1, 0, 1)] for i, j in own]
    once = _triples(main, number) + _triples(main + number, number)
    penalties = tuple(
        _differences(t, cells.shape[1], ridge) for t, ridge in ((along_s, ()), (along_r, ()), (once, range(main, cells.shape[1])))
    )
    flat = np.ones(cells.shape[1])
    flat[main:] = 0.05
    step = (high - low) / level
    return DensityBasis(low - step, high + step, size, cells, penalties, total, flat, number, number)
