"""The piecewise-uniform Preisach operator in NumPy, streaming, with the exact inverse of T&B Sec. 3.1, algorithm (6).

State: alternating extrema of the field with M stored at each (return-point memory), tip last. Within a cell of the
branch M is a quadratic of the field; the walk goes cell by cell and corner by corner, so that the inverse takes no
more than n_c + L iterations and is exact to rounding.
"""

import bisect
import math

import numpy as np

from ..errors import ConfigurationError

ROUNDING = 2e-15  # of the summed masses: what the sums of the Everett table leave


class PlainPreisach:
    """A Preisach operator with memory. `masses` (L, L), A/m, [alpha row, beta column]; `low`, `high`: plane, A/m.

    `history`: fields that lead to the start state from negative saturation. Attributes after each call: `field`,
    `magnetization` (A/m), `saturated` (the target was out of range), `unique` (False on a plateau of zero density),
    `iterations` of the last inversion; after `invert` also `saturated_at` and `ambiguous_at`, (time,) (the latter None if compiled).
    """

    def __init__(self, masses, low: float, high: float, offset: float = 0.0, history=()):
        masses = np.asarray(masses, float)
        if masses.ndim != 2 or masses.shape[0] != masses.shape[1] or masses.size == 0:
            raise ConfigurationError(f"masses must be L x L, not {masses.shape}")
        if not np.all(np.isfinite(masses)) or np.any(np.triu(masses, 1)):
            row, column = np.argwhere(~np.isfinite(masses) | (np.triu(masses, 1) != 0))[0]
            raise ConfigurationError(
                f"masses[{row}, {column}] = {masses[row, column]:g}; give numbers, zero above the diagonal (beta <= alpha)"
            )
        if not -math.inf < low < high < math.inf or not math.isfinite(offset):
            raise ConfigurationError(f"the Preisach plane {low} .. {high} A/m with offset {offset} A/m; give low < high")
        if masses.min() < 0:
            row, column = np.unravel_index(int(masses.argmin()), masses.shape)
            raise ConfigurationError(
                f"masses[{row}, {column}] is negative: the operator is not monotone and has no inverse; use masses >= 0"
            )
        self.cells, self.low, self.high, self.offset = len(masses), float(low), float(high), float(offset)
        self.step = (self.high - self.low) / self.cells
        self.levels = [self.low + self.step * k for k in range(self.cells)] + [self.high]
        self.total = float(masses.sum())
        table = np.zeros((self.cells + 1, self.cells + 1))
        table[1:, : self.cells] = np.cumsum(np.cumsum(masses, axis=0)[:, ::-1], axis=1)[:, ::-1]
        k = np.arange(self.cells)
        table[k, k + 1] = masses[k, k]
        self._table, self._diagonal = table.tolist(), masses[k, k].tolist()
        self.extrema = [(self.low, self.offset - self.total)]  # (field, M), alternating; the tip is the last
        self.saturated, self.unique, self.iterations = False, True, 0
        self.saturated_at = self.ambiguous_at = None
        for value in history:
            self.apply(float(value))

    @property
    def field(self) -> float:
        """Present field, A/m."""
        return self.extrema[-1][0]

    @property
    def magnetization(self) -> float:
        """Present M, A/m."""
        return self.extrema[-1][1]

    @property
    def corners(self) -> int:
        """n_c of the memory curve."""
        return len(self.extrema) - 1

    def copy(self) -> "PlainPreisach":
        """The same operator with its own memory."""
        other = object.__new__(PlainPreisach)
        other.__dict__ = dict(self.__dict__)
        other.extrema = list(self.extrema)
        return other

    def _cell(self, field, rising):
        """Row that a rising (column that a falling) field moves in, by the stored levels themselves."""
        k = bisect.bisect_right(self.levels, field) - 1 if rising else bisect.bisect_left(self.levels, field) - 1
        return min(max(k, 0), self.cells - 1)

    def _local(self, field):
        k = self._cell(field, True)
        return k, (field - self.levels[k]) / self.step

    def everett(self, alpha: float, beta: float) -> float:
        """T(alpha, beta), A/m."""
        i, p = self._local(alpha)
        j, q = self._local(beta)
        t, d = self._table, self._diagonal
        square = (1 - p) * ((1 - q) * t[i][j] + q * t[i][j + 1]) + p * ((1 - q) * t[i + 1][j] + q * t[i + 1][j + 1])
        return square - p * (1 - p) * d[i] - q * (1 - q) * d[j]

    def _quadratic(self, cell, threshold, rising):
        """T on the branch in a cell as c0 + c1 z + c2 z^2, z local."""
        j, q = self._local(threshold)
        t, d = self._table, self._diagonal
        bend = q * (1 - q) * d[j]
        if rising:
            first, second = ((1 - q) * t[k][j] + q * t[k][j + 1] - bend for k in (cell, cell + 1))
        else:
            first, second = ((1 - q) * t[j][k] + q * t[j + 1][k] - bend for k in (cell, cell + 1))
        return first, second - first - d[cell], d[cell]

    def _direction(self, rising):
        """Let the tip be the start of a branch in this direction: a change of direction keeps it as a corner."""
        if len(self.extrema) >= 2 and (self.extrema[-1][0] > self.extrema[-2][0]) == rising:
            self.extrema.pop()
        return self.extrema[-1]

    def apply(self, field: float) -> float:
        """Lead the field to a new value (clipped to the plane); returns M, A/m."""
        if field != field:
            raise ConfigurationError("the field is NaN; mend the drive first")
        field = min(max(float(field), self.low), self.high)
        if field == self.field:
            return self.magnetization
        rising = field > self.field
        base, m_base = self._direction(rising)
        while (
            len(self.extrema) >= 2
            and (self.extrema[-2][0] <= field if rising else self.extrema[-2][0] >= field)
            and len(self.extrema) >= 3
        ):
            del self.extrema[-2:]
            base, m_base = self.extrema[-1]
        if len(self.extrema) == 2 and not rising and field <= self.extrema[0][0]:
            del self.extrema[1:]
            self.extrema = [(self.low, self.offset - self.total)]
            return self.magnetization
        m = m_base + 2 * self.everett(field, base) if rising else m_base - 2 * self.everett(base, field)
        self.extrema.append((field, m))
        return m

    def solve(self, target: float, slope: float = 0.0) -> float:
        """The field v with slope * v + M(v) = target, and the memory led there; `slope` = 0 inverts M itself, (6).

        Out of range: the nearest end of the plane with `saturated` set. On a plateau the nearest field, `unique` False.
        Raises `ConfigurationError` for NaN, and keeps the memory.
        """
        self.saturated, self.unique, self.iterations = False, True, 0
        value = slope * self.field + self.magnetization
        if target == value:
            self.unique = slope > 0 or not (self._flat(True) or self._flat(False))
            return self.field
        if target != target or not slope >= 0:
            raise ConfigurationError(f"target {target} with slope {slope}; give a number, and a slope of zero or more")
        rising = target > value
        near = ROUNDING * self.total if slope == 0 else 0.0  # else rounding would carry the field across a plateau
        while True:
            start = self.field
            if (start >= self.high) if rising else (start <= self.low):
                self.saturated = True
                if slope > 0:  # beyond the plane M is constant
                    return (target - self.magnetization) / slope
                return start
            base, m_base = self._branch_base(rising)
            limit = self._next_corner(rising)
            cell = self._cell(start, rising)
            edge = self.levels[cell + 1] if rising else self.levels[cell]
            stop = min(edge, limit) if rising else max(edge, limit)
            self.iterations += 1
            m_stop = self._corner_value(stop, rising, base, m_base)
            reached = slope * stop + m_stop
            if (reached >= target - near) if rising else (reached <= target + near):
                v = self._within(start, stop, cell, base, m_base, rising, target, slope)
                if v != start:  # a corner without a move would make two of one
                    self._advance(v, rising, base, m_base)
                if v == stop and slope == 0:  # inside a cell M rises with the field; a plateau can only begin at its end
                    self.unique = not self._flat(rising)
                return v
            self._advance(stop, rising, base, m_base, m_stop)

    def _flat(self, rising) -> bool:
        """Does M stay as it is when the field goes on this way? (Nothing switches in the cell ahead.)"""
        if (self.field >= self.high) if rising else (self.field <= self.low):
            return False  # the end of the plane
        base, _ = self._branch_base(rising)
        _, c1, c2 = self._quadratic(self._cell(self.field, rising), base, rising)
        return abs(c1) + abs(c2) <= ROUNDING * self.total

    def _branch_base(self, rising):
        tip = self.extrema[-1]
        if len(self.extrema) >= 2 and (tip[0] > self.extrema[-2][0]) == rising:
            return self.extrema[-2]
        return tip

    def _next_corner(self, rising):
        """The field at which the next corner is wiped out, or the end of the plane."""
        tip_moves = len(self.extrema) >= 2 and (self.extrema[-1][0] > self.extrema[-2][0]) == rising
        index = len(self.extrema) - (3 if tip_moves else 2)
        if index >= 0 and not (index == 0 and rising):
            return self.extrema[index][0]
        return self.high if rising else self.low

    def _corner_value(self, field, rising, base, m_base):
        return m_base + 2 * self.everett(field, base) if rising else m_base - 2 * self.everett(base, field)

    def _within(self, start, stop, cell, base, m_base, rising, target, slope):
        """Solve the quadratic of one cell from `start` towards `stop`."""
        c0, c1, c2 = self._quadratic(cell, base, rising)
        sign = 1.0 if rising else -1.0
        z = (start - self.levels[cell]) / self.step
        here = slope * start + m_base + sign * 2 * (c0 + c1 * z + c2 * z * z)
        rho = max(sign * (target - here), 0.0)
        b = slope * self.step + 2 * sign * (c1 + 2 * c2 * z)
        root = b + math.sqrt(max(b * b + 8 * c2 * rho, 0.0))
        v = start + sign * (2 * rho / root if root > 0 else 0.0) * self.step
        return min(v, stop) if rising else max(v, stop)

    def _advance(self, field, rising, base, m_base, m=None):
        m = self._corner_value(field, rising, base, m_base) if m is None else m
        if len(self.extrema) >= 2 and (self.extrema[-1][0] > self.extrema[-2][0]) == rising:
            self.extrema.pop()
        self.extrema.append((field, m))
        # reaching a corner wipes it out together with the one after it: the branch goes on from the older base
        while len(self.extrema) >= 4 and (self.extrema[-3][0] <= field if rising else self.extrema[-3][0] >= field):
            tip = self.extrema[-1]
            del self.extrema[-3:]
            self.extrema.append(tip)
        if not rising and len(self.extrema) == 3 and field <= self.extrema[0][0]:
            self.extrema = [(self.low, self.offset - self.total)]

    def invert(self, targets, accelerate: bool = False) -> np.ndarray:
        """Fields for a sequence of wanted M, A/m, carrying the memory along; `accelerate`: compiled by numba."""
        targets = np.asarray(targets, float)
        if np.isnan(targets).any():
            raise ConfigurationError(f"target nan at sample {int(np.argmax(np.isnan(targets)))}; give numbers")
        if accelerate:
            from .accelerated import invert_many

            fields, _, saturated, _ = invert_many(self, targets)
            self.saturated = bool(saturated[-1]) if len(saturated) else False
            self.saturated_at, self.ambiguous_at = saturated, None
            return fields
        fields, self.saturated_at, self.ambiguous_at = np.empty(len(targets)), *np.zeros((2, len(targets)), bool)
        for k, target in enumerate(targets.tolist()):
            fields[k] = self.solve(target)
            self.saturated_at[k], self.ambiguous_at[k] = self.saturated, not self.unique
        return fields
