"""Certified bounds below gamma*: the rows of the first samples only, and their dual.

The first N samples of every closed loop depend on the first N taps of Q alone, so a programme over them bounds the
optimum from below. Its multipliers certify it whatever their rounding, provided that the variables are bounded: ||Q||_1
by the saturation row, by the robustness row where 1/W_0 is stable, or by the tracking error where 1/g is. For an unstable
plant the pair X, V of the Bezout identity is bounded instead (`sizes_of_pair`). A plant with
zeros inside the disc and neither row needs the interpolation conditions S(zero) = 1 instead, S = 1 - g Q, since cut rows
cannot see them (Dahleh and Diaz-Bobillo, Control of Uncertain Systems, 1995).
"""

import types

import numpy as np
import scipy.sparse as sp

from .l1 import Channels, dual_bound, programme
from .problem import TrackingProblem, response, roots_of

SERIES = 200000  # terms of 1/W_0, whose zero lies as near to the circle as 1.0005


def lower_bound(problem: TrackingProblem, rows: int, gamma: float) -> float:
    """A number below gamma*, um, from the first `rows` samples; `gamma`: the upper bound already reached. 0 where nothing bounds Q."""
    if len(problem.factors()[2]) > 1:
        sizes = sizes_of_pair(problem, gamma)
        return _cut_rows(problem, rows, gamma, np.repeat(sizes, rows)) if np.all(np.isfinite(sizes)) else 0.0
    most = size_of_q(problem, gamma)
    best = 0.0 if most is None else _cut_rows(problem, rows, gamma, most)
    if gamma - best > 1e-7 * gamma:
        best = max(best, _by_interpolation(problem, rows, gamma))
    return best


def _cut_rows(problem, rows, gamma, most):
    found, parts = programme(Channels(problem, rows, rows), problem.u_bar, 0.0, bound=most)
    if found.status != 0:
        return 0.0
    widest = float(np.max(most))
    largest = max(widest, problem.u_bar if np.isfinite(problem.u_bar) else 0.0, 2 * gamma, 1.0, problem.w_bar * widest)
    return max(dual_bound(found, parts, largest), 0.0)


def sizes_of_pair(problem: TrackingProblem, gamma: float) -> tuple[float, float]:
    """What ||X||_1 and ||V||_1 of the Bezout pair cannot exceed in a loop with a tracking error below `gamma`; inf if unknown.

    T = lambda^2 n X has ||T|| <= 1 + gamma/r_bar and vanishes at the zeros inside the disc, S = 1 - T = d_u V at the unstable
    poles, Q = d X at those too. A series that vanishes at p, divided by 1 - lambda/p, grows by |p|/(1 - |p|) at most.
    """
    n, d_s, d_u = problem.factors()
    poles = roots_of(d_u)
    loop, grows = 1 + gamma / problem.r_bar, _growth(poles)
    V = (1 + loop) * grows
    zeros = roots_of(n) if len(np.trim_zeros(n)) > 1 else np.array([])
    inside, outside = zeros[np.abs(zeros) < 1], zeros[np.abs(zeros) >= 1]
    outer = np.trim_zeros(n, "f")[0] * np.real(np.poly(1 / outside)) if len(outside) else np.trim_zeros(n, "f")[:1]
    X = [loop * _norm_of_inverse(outer, [1.0]) * _growth(inside[np.abs(inside) > 1e-12])]
    stable = _norm_of_inverse(d_s, [1.0]) * grows
    if np.isfinite(problem.u_bar):
        X.append(problem.u_bar / problem.r_bar * stable)
    if problem.robust:
        X.append(_norm_of_inverse(*problem.weight) * stable)
    return min(X), V


def _growth(points) -> float:
    size = np.abs(points)
    return float(np.prod(size / (1 - size)))


def size_of_q(problem: TrackingProblem, gamma: float) -> float | None:
    """What ||Q||_1 cannot exceed in a loop that keeps the rows with a tracking error below `gamma`; None if unknown."""
    sizes = []
    if np.isfinite(problem.u_bar):
        sizes.append(problem.u_bar / problem.r_bar)
    n, d = (np.asarray(p, float) for p in problem.plant)
    if problem.robust:
        sizes.append(_norm_of_inverse(*problem.weight))
    inverse = _norm_of_inverse(n, d)
    sizes.append(inverse * (1 + gamma / problem.r_bar))
    least = min(sizes)
    return least if np.isfinite(least) else None


def _norm_of_inverse(numerator, denominator) -> float:
    """||denominator/numerator||_1 with what is left of the series, or inf where it is unstable."""
    numerator = np.asarray(numerator, float)
    if numerator[0] == 0:
        return np.inf
    zeros = roots_of(numerator) if len(np.trim_zeros(numerator, "b")) > 1 else np.array([np.inf])
    radius = 1 / np.abs(zeros).min()
    if radius >= 1:
        return np.inf
    terms = np.abs(response(denominator, numerator, SERIES))
    return float(terms.sum() + 2 * terms[-1] / (1 - radius))


def _by_interpolation(problem, taps, gamma):
    """min over S = 1 - g Q with S = 1 at the plant's zeros inside the disc; the taps left out weigh |zero|^N gamma/r."""
    n, d, _ = problem.factors()
    zeros = roots_of(n) if len(np.trim_zeros(n)) > 1 else np.array([])
    zeros = np.concatenate([zeros, [0.0] if n[0] == 0 else []])
    inside = [z for z in zeros if abs(z) < 1 and np.imag(z) >= 0]
    single = [z for k, z in enumerate(inside) if all(abs(z - v) > 1e-6 for v in inside[:k])]
    r, w = problem.r_bar, problem.w_bar
    G = np.append(0.0, response(n, d, taps))[:taps]
    late = np.concatenate([[0.0, 0.0], G])[:taps]
    rows = [part(np.power(complex(z), np.arange(taps))) for z in single for part in (np.real, np.imag)]
    goals = [v for _ in single for v in (1.0, 0.0)]
    left = [abs(z) ** taps * gamma / r for z in single for _ in range(2)]
    matrix = sp.diags_array([np.full(taps, v) for v in late], offsets=-np.arange(taps), shape=(taps, taps)).tocsr()
    pieces = {"error_r": (np.zeros(taps), r * sp.eye_array(taps).tocsr()), "error_w": (-w * (G - late), -w * matrix)}
    equal = (sp.csr_array(np.array(rows).reshape(-1, taps)), np.array(goals)) if rows else None
    channels = types.SimpleNamespace(pieces=pieces, columns=taps, rows=taps, equalities=equal)
    found, parts = programme(channels, np.inf, 0.0, bound=gamma / r)
    return max(dual_bound(found, parts, max(2 * gamma, gamma / r, 1.0), np.array(left)), 0.0) if found.status == 0 else 0.0
