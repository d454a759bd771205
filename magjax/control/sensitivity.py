"""The pure sensitivity problem min ||1 - P Q||_1 by zero interpolation, exact in rationals.

S = 1 - P Q must be 1 at the plant's zeros and 0 at its poles inside the unit disc |lambda| < 1 (Dahleh and
Diaz-Bobillo, Control of Uncertain Systems, 1995). Finitely many conditions: the optimal S is a polynomial, and a dual
vector certifies it.
"""

import dataclasses
from fractions import Fraction

import numpy as np
from scipy.optimize import linprog

from ..errors import ConfigurationError


@dataclasses.dataclass(frozen=True)
class Optimum:
    """`value`: the least ||S||_1; `S`: its coefficients in rising powers of lambda; `dual`: the certificate, one entry
    per condition: |sum_j dual_j point_j^k| <= 1 for every k and sum_j dual_j wanted_j = value; `exact`: in rationals."""

    value: Fraction | float
    S: dict
    dual: tuple
    exact: bool


def optimal_sensitivity(zeros, poles=(), horizon: int = 80) -> Optimum:
    """Least ||1 - P Q||_1 over stable Q, for a plant with these zeros and poles in |lambda| < 1 (real, simple).

    Give numbers as `Fraction`, int or str ("3/2") for an exact answer. A pure delay is a zero at 0. Raises
    `ConfigurationError` for points outside the disc, repeated points, or a pole on a zero.

    >>> optimal_sensitivity([0], ["1/2"]).value
    Fraction(3, 1)
    """
    points = [Fraction(z) for z in zeros] + [Fraction(p) for p in poles]
    wanted = [Fraction(1)] * len(list(zeros)) + [Fraction(0)] * len(list(poles))
    if not points or any(abs(p) >= 1 for p in points):
        raise ConfigurationError("give the zeros and poles inside the unit disc, |lambda| < 1; those outside do not constrain S")
    if len(set(points)) < len(points):
        raise ConfigurationError("a zero or pole is repeated, or a pole lies on a zero: interpolation needs simple, different points")
    if not zeros:
        return Optimum(Fraction(0), {}, (Fraction(0),) * len(points), True)
    A = np.array([[float(p) ** k for k in range(horizon)] for p in points])
    found = linprog(np.ones(2 * horizon), A_eq=np.hstack([A, -A]), b_eq=np.array([float(w) for w in wanted]), method="highs")
    if found.status != 0:
        raise ConfigurationError(f"the interpolation programme ended with: {found.message}")
    s = found.x[:horizon] - found.x[horizon:]
    dual = found.eqlin.marginals
    support = sorted(np.argsort(-np.abs(s))[: len(points)])
    return _rational(points, wanted, support, dual) or Optimum(float(np.abs(s).sum()), dict(enumerate(s)), tuple(dual), False)


def _rational(points, wanted, support, dual):
    """Primal on its support and dual on the same powers solved in rationals; None where they do not certify."""
    columns = [[p ** int(k) if k else Fraction(1) for k in support] for p in points]
    S = _solve(columns, wanted)
    if S is None:
        return None
    signs = [Fraction(1) if v > 0 else Fraction(-1) if v < 0 else Fraction(int(np.sign(np.dot(dual, [float(c[i]) for c in columns])) or 1)) for i, v in enumerate(S)]
    multipliers = _solve([list(row) for row in zip(*columns, strict=True)], signs)
    if multipliers is None:
        return None
    bound, k = sum(abs(m) for m in multipliers), 0
    largest = max(abs(p) for p in points)
    while bound * largest**k > 1 and k < 2000:  # beyond, the powers have died out below 1
        if abs(sum(m * (p**k if k else 1) for m, p in zip(multipliers, points, strict=True))) > 1:
            return None
        k += 1
    value = sum(abs(v) for v in S)
    if value != sum(m * w for m, w in zip(multipliers, wanted, strict=True)):
        return None
    return Optimum(value, dict(zip((int(k) for k in support), S, strict=True)), tuple(multipliers), True)


def _solve(matrix, rhs):
    """Gauss elimination in rationals; None if singular."""
    rows = [list(r) + [b] for r, b in zip(matrix, rhs, strict=True)]
    n = len(rows)
    for i in range(n):
        pivot = next((k for k in range(i, n) if rows[k][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                rows[k] = [a - rows[k][i] * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [r[-1] for r in rows]
