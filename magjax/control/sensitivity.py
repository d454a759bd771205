"""The pure sensitivity problem min ||1 - P Q||_1 by zero interpolation, exact in rationals.

S = 1 - P Q must be 1 at the plant's zeros and 0 at its poles inside the unit disc |lambda| < 1, with vanishing
derivatives where these are repeated (Dahleh and Diaz-Bobillo, Control of Uncertain Systems, 1995). Finitely many
conditions: the optimal S is a polynomial, and a dual vector certifies it.
"""

import dataclasses
from fractions import Fraction
from math import comb

import numpy as np
from scipy.optimize import linprog

from ..errors import ConfigurationError


@dataclasses.dataclass(frozen=True)
class Optimum:
    """`value`: the least ||S||_1; `S`: its coefficients in rising powers of lambda; `dual`: the certificate, one entry
    per condition (zeros, then poles; the m-th repetition of a point stands for the m-th derivative over m!):
    |sum_j dual_j binom(k, m_j) point_j^(k - m_j)| <= 1 for every k and sum_j dual_j wanted_j = value; `exact`: in rationals."""

    value: Fraction | float
    S: dict
    dual: tuple
    exact: bool


def optimal_sensitivity(zeros, poles=(), horizon: int = 80) -> Optimum:
    """Least ||1 - P Q||_1 over stable Q, for a plant with these zeros and poles in |lambda| < 1 (real).

    Give numbers as `Fraction`, int or str ("3/2") for an exact answer; name a point as often as it is repeated. A pure
    delay is a zero at 0, two samples of delay are two. Raises `ConfigurationError` for points outside the disc, complex
    ones, or a pole on a zero.

    >>> optimal_sensitivity([0], ["1/2"]).value
    Fraction(3, 1)
    """
    try:
        places, resonances = [Fraction(z) for z in zeros], [Fraction(p) for p in poles]
    except (TypeError, ValueError):
        raise ConfigurationError(
            "zeros and poles must be real numbers (int, Fraction or text like '3/2'); for complex ones call design with u_bar=inf"
        ) from None
    if not (places or resonances) or any(abs(p) >= 1 for p in places + resonances):
        raise ConfigurationError("give the zeros and poles inside the unit disc, |lambda| < 1; those outside do not constrain S")
    if set(places) & set(resonances):
        raise ConfigurationError("a pole lies on a zero: no controller can stabilize this plant")
    points = [(p, group[:k].count(p)) for group in (places, resonances) for k, p in enumerate(group)]
    wanted = [Fraction(int(k < len(places) and m == 0)) for k, (_, m) in enumerate(points)]
    if not places:
        return Optimum(Fraction(0), {}, (Fraction(0),) * len(points), True)
    A = np.array([[float(_power(p, k)) for k in range(horizon)] for p in points])
    found = linprog(np.ones(2 * horizon), A_eq=np.hstack([A, -A]), b_eq=np.array([float(w) for w in wanted]), method="highs")
    if found.status != 0:
        raise ConfigurationError(f"the interpolation programme ended with: {found.message}")
    s = found.x[:horizon] - found.x[horizon:]
    dual = found.eqlin.marginals
    support = sorted(np.argsort(-np.abs(s))[: len(points)])
    return _rational(points, wanted, support, dual) or Optimum(float(np.abs(s).sum()), dict(enumerate(s)), tuple(dual), False)


def _power(point, k: int) -> Fraction:
    """The m-th derivative over m! of lambda^k at a point (p, m)."""
    p, m = point
    return comb(k, m) * p ** (k - m) if k >= m else Fraction(0)


def _rational(points, wanted, support, dual):
    """Primal on its support and dual on the same powers solved in rationals; None where they do not certify."""
    columns = [[_power(p, int(k)) for k in support] for p in points]
    S = _solve(columns, wanted)
    if S is None:
        return None
    signs = [
        Fraction(1)
        if v > 0
        else Fraction(-1)
        if v < 0
        else Fraction(int(np.sign(np.dot(dual, [float(c[i]) for c in columns])) or 1))
        for i, v in enumerate(S)
    ]
    multipliers = _solve([list(row) for row in zip(*columns, strict=True)], signs)
    if multipliers is None:
        return None
    bound, k = sum(abs(m) for m in multipliers), 0
    largest, most = max(abs(p) for p, _ in points), max(m for _, m in points)
    settled = most / (1 - largest) + most  # from here on binom(k, m) largest^(k - m) falls
    while k <= settled or bound * comb(k, most) * largest ** (k - most) > 1:  # beyond, the powers have died out below 1
        if k > 4000 or abs(sum(m * _power(p, k) for m, p in zip(multipliers, points, strict=True))) > 1:
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
