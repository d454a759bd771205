"""A slow Preisach operator and a slow coupled step, written from T&B Sec. 2 alone.

The operator tracks every cell: cell (i, j) of the plane holds a square (or, on the diagonal, a triangle) of relays of
uniform density; the share of relays that are up is the area below the memory curve in that cell, found from the
staircase by polygons, not by an Everett function.
"""

import numpy as np


class SlowPreisach:
    """Relays as a fine raster would see them in the limit: exact areas of the staircase's polygon in each cell."""

    def __init__(self, masses, low, high):
        self.masses, self.low, self.high = np.asarray(masses, float), float(low), float(high)
        self.levels = np.linspace(low, high, len(masses) + 1)
        self.history = [float(low)]  # field values, oldest first, starting in negative saturation

    def copy(self):
        other = SlowPreisach(self.masses, self.low, self.high)
        other.history = list(self.history)
        return other

    def apply(self, field):
        self.history.append(float(np.clip(field, self.low, self.high)))
        self.history = self._reduce(self.history)
        return self.output()

    @staticmethod
    def _reduce(history):
        """Keep the start, then each later extremum that no later one has wiped out: brute force over the last extremes."""
        kept = [history[0]]
        rest = history[1:]
        while rest:
            top = max(range(len(rest)), key=lambda k: (rest[k], k))
            bottom = min(range(len(rest)), key=lambda k: (rest[k], -k))
            if rest[top] <= kept[-1] and rest[bottom] >= kept[-1] and len(kept) == 1:
                break
            if len(kept) % 2 == 1:  # next kept is a maximum
                kept.append(rest[top])
                rest = rest[top + 1 :]
            else:
                kept.append(rest[bottom])
                rest = rest[bottom + 1 :]
        return kept

    def up_area(self, a0, a1, b0, b1, triangle):
        """Area of {relays up} within beta in [b0, b1], alpha in [a0, a1] (the part alpha >= beta if triangle)."""
        # relay (alpha, beta) is up iff the last crossing was of alpha from below: replay the reduced history on
        # the band structure: after each maximum x all alpha <= x go up, after each minimum x all beta >= x go down
        cuts_a = sorted({a0, a1, *[h for h in self.history if a0 < h < a1]})
        cuts_b = sorted({b0, b1, *[h for h in self.history if b0 < h < b1]})
        area = 0.0
        for x0, x1 in zip(cuts_a[:-1], cuts_a[1:], strict=True):
            for y0, y1 in zip(cuts_b[:-1], cuts_b[1:], strict=True):
                up = False
                ma, mb = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
                for before, now in zip(self.history[:-1], self.history[1:], strict=True):
                    if now > before and ma < now:
                        up = True
                    elif now < before and mb > now:
                        up = False
                if up:
                    area += _half_square(x0, x1, y0, y1) if triangle else (x1 - x0) * (y1 - y0)
        return area

    def output(self):
        total = 0.0
        for i in range(len(self.masses)):
            for j in range(i + 1):
                a0, a1, b0, b1 = self.levels[i], self.levels[i + 1], self.levels[j], self.levels[j + 1]
                whole = (a1 - a0) * (b1 - b0) * (0.5 if i == j else 1.0)
                total += self.masses[i, j] * (2 * self.up_area(a0, a1, b0, b1, i == j) / whole - 1)
        return total


def _half_square(x0, x1, y0, y1):
    """Area of [x0, x1] x [y0, y1] where alpha = x >= beta = y."""
    if y1 <= x0:
        return (x1 - x0) * (y1 - y0)
    if y0 >= x1:
        return 0.0
    # both intervals coincide on the grid of cuts
    return 0.5 * (x1 - x0) * (y1 - y0)


def slow_trapezoid(operator, current, h, c0, H_bias, c1):
    """T&B (4) by the trapezoid rule, each step by bisection on a fresh copy of the memory: (H, M)."""
    H = c0 * current[0] + H_bias
    M = operator.apply(H)
    fields, magnetizations = [H], [M]
    for before, now in zip(current[:-1], current[1:], strict=True):
        drive = 0.5 * h * c1 * (before + now + 2 * H_bias / c0)
        rhs = H + M - 0.5 * h * c1 * H / c0 + drive
        low, high = operator.low - 1e5, operator.high + 1e5
        for _ in range(200):
            middle = 0.5 * (low + high)
            value = middle * (1 + 0.5 * h * c1 / c0) + operator.copy().apply(middle)
            low, high = (middle, high) if value < rhs else (low, middle)
            if high - low < 1e-11:
                break
        H = 0.5 * (low + high)
        M = operator.apply(H)
        fields.append(H)
        magnetizations.append(M)
    return np.asarray(fields), np.asarray(magnetizations)
