"""l1-optimal tracking by one sparse linear programme over the Youla parameter, T&B Sec. 4.2.

For a stable plant every closed loop is affine in Q = K/(1 + lambda G_a K). With FIR Q the programme gives an upper
bound; with the rows cut to the first taps, and its dual, a lower bound: both certify gamma*. An unstable plant is
written with a polynomial Bezout pair, 1 = lambda^2 n X + d_u V, Q = d X.
"""

import dataclasses
import time

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from ..errors import ConfigurationError
from .problem import TrackingProblem, response

BACK_OFF = 3e-7  # HiGHS works to 1e-7: hard rows are asked for with this to spare, more where that was not enough
MOST_TAIL = 4000
MOST_TAPS = 1000  # beyond, the programme takes minutes
CLOSE = 1e-6  # relative gap that needs no better lower bound


@dataclasses.dataclass(frozen=True)
class Design:
    """A certified design. `Q`: taps; `gamma`, `lower`: bounds of gamma*, um; `norms`: l1 norms re-evaluated from Q:
    error_r, error_w (um), control_r, control_w (M_s^2), robust; `seconds`: of the programmes."""

    problem: TrackingProblem
    Q: np.ndarray
    gamma: float
    lower: float
    norms: dict
    seconds: float
    pair: tuple | None = None  # numerator and denominator of K where the plant is unstable

    @property
    def gap(self) -> float:
        """Certified relative gap."""
        return (self.gamma - self.lower) / max(self.gamma, 1e-300)

    @property
    def control(self) -> float:
        """Largest control that any admissible reference and noise can ask for, M_s^2."""
        return self.norms["control_r"] + self.norms["control_w"]


class Channels:
    """The five closed-loop impulse responses, each constant + matrix @ x, over `rows` samples."""

    def __init__(self, problem: TrackingProblem, taps: int, rows: int):
        n, d_s, d_u = problem.factors()
        self.taps, self.rows, self.problem = taps, rows, problem
        self.unstable = len(d_u) > 1
        d = np.convolve(d_s, d_u)
        W = response(*problem.weight, rows)
        r, w = problem.r_bar, problem.w_bar
        square = np.zeros(rows)
        square[2] = r
        if self.unstable:  # x = [X, V]
            g_s = response(np.append(0.0, n), d_s, rows)
            self.columns = 2 * taps
            self.loop = self._both(self._shift(n, 2), None)
            self.q = self._both(d, None)
            V = self._both(None, g_s)
            self.pieces = {
                "error_r": (square, -r * self.loop), "error_w": (np.zeros(rows), -w * V),
                "control_r": (np.zeros(rows), r * self._delay(self.q)), "control_w": (np.zeros(rows), -w * self.loop),
                "robust": (np.zeros(rows), -self._both(np.convolve(np.append(0.0, d), W)[:rows], None)),
            }  # fmt: skip
            bezout = self._both(self._shift(n, 2), d_u)
            one = np.zeros(rows)
            one[0] = 1.0
            keep = taps + max(len(n) + 2, len(d_u))
            self.equalities = (bezout[:keep], one[:keep])
        else:
            self.columns = taps
            g = response(n, d, rows)
            G = np.append(0.0, g)[:rows]  # G_a = lambda g
            lG = np.append(0.0, G)[:rows]
            self.q = self._toeplitz(np.eye(1, rows)[0])
            self.loop = self._toeplitz(lG)
            self.pieces = {
                "error_r": (square, -r * self.loop), "error_w": (-w * G, w * self._toeplitz(np.convolve(G, lG)[:rows])),
                "control_r": (np.zeros(rows), r * self._delay(self.q)), "control_w": (np.zeros(rows), -w * self.loop),
                "robust": (np.zeros(rows), -self._delay(self._toeplitz(W))),
            }  # fmt: skip
            self.equalities = None
        if not problem.robust:
            del self.pieces["robust"]

    @staticmethod
    def _shift(polynomial, by):
        return np.concatenate([np.zeros(by), polynomial])

    def _toeplitz(self, column):
        """Multiplication of an FIR of `taps` by a series, (rows, taps), small entries dropped."""
        column = np.asarray(column, float)[: self.rows]
        used = np.flatnonzero(np.abs(column) > 1e-17 * np.abs(column).max(initial=1e-300))
        last = used[-1] + 1 if len(used) else 1
        offsets = -np.arange(last)
        return sp.diags_array([np.full(self.rows, v) for v in column[:last]], offsets=offsets, shape=(self.rows, self.taps)).tocsr()

    def _both(self, first, second):
        """[X, V] -> first * X + second * V."""
        zero = sp.csr_array((self.rows, self.taps))
        return sp.hstack([zero if c is None else self._toeplitz(c) for c in (first, second)]).tocsr()

    def _delay(self, matrix):
        return sp.vstack([sp.csr_array((1, matrix.shape[1])), matrix[:-1]]).tocsr()

    def exact(self, x):
        """The nearest pair that satisfies the Bezout identity to rounding, not to HiGHS's 1e-7; Q is left as it is."""
        if self.equalities is None:
            return x
        A, b = self.equalities[0].toarray(), self.equalities[1]
        return x + np.linalg.lstsq(A, b - A @ x, rcond=None)[0]

    def norms(self, x) -> dict:
        """l1 norm of each channel."""
        return {k: float(np.abs(c + A @ x).sum()) for k, (c, A) in self.pieces.items()}


def programme(channels: Channels, u_bar: float, slack: float, minimum_control: bool = False, bound=None):
    """min gamma (or the control's norm) over x, with one absolute value per coefficient."""
    parts = {k: v for k, v in channels.pieces.items() if np.isfinite(u_bar) or minimum_control or not k.startswith("control")}
    n, rows = channels.columns, channels.rows
    names = list(parts)
    m = len(names) * rows
    A = sp.vstack([parts[k][1] for k in names])
    c = np.concatenate([parts[k][0] for k in names])
    eye = sp.eye_array(m)
    zero = sp.csr_array((m, 1))
    # |A x + c| <= t
    rows_abs = [sp.hstack([A, -eye, zero]), sp.hstack([-A, -eye, zero])]
    rhs = [-c, c]
    groups = (("error_", None), ("control_", u_bar), ("robust", 1.0))
    for start, limit in groups:
        inside = np.repeat([k.startswith(start) for k in names], rows)
        objective = start == ("control_" if minimum_control else "error_")
        if not inside.any() or (minimum_control and start == "error_"):
            continue
        row = sp.csr_array(np.concatenate([np.zeros(n), inside.astype(float), [-1.0 if objective else 0.0]])[None])
        rows_abs.append(row)
        rhs.append(np.array([0.0 if objective else limit * (1 - slack)]))
    cost = np.zeros(n + m + 1)
    cost[-1] = 1.0
    equal = channels.equalities
    A_eq = None if equal is None else sp.hstack([equal[0], sp.csr_array((equal[0].shape[0], m + 1))])
    b_eq = None if equal is None else equal[1]
    lower = np.concatenate([np.full(n, -np.inf if bound is None else -bound), np.zeros(m + 1)])
    upper = np.concatenate([np.full(n, np.inf if bound is None else bound), np.full(m + 1, np.inf)])
    A_ub, b_ub = sp.vstack(rows_abs).tocsr(), np.concatenate(rhs)
    limits = np.stack([lower, upper], axis=1)
    for method in ("highs", "highs-ipm", "highs-ds"):  # degenerate optima (Q = 0) stop one now and then
        found = linprog(cost, A_ub, b_ub, A_eq, b_eq, limits, method=method)
        if found.status in (0, 2):
            break
    return found, (cost, A_ub, b_ub, A_eq, b_eq, lower, upper)


def dual_bound(found, parts, most: float, loose=0.0) -> float:
    """A bound below the optimum from HiGHS's multipliers, valid whatever their rounding: variables lie within `most`.

    `loose`: by how much each equality may be missed.
    """
    cost, A_ub, b_ub, A_eq, b_eq, lower, upper = parts
    y = np.minimum(found.ineqlin.marginals, 0.0)
    reduced = cost - A_ub.T @ y
    value = float(b_ub @ y)
    if A_eq is not None:
        reduced = reduced - A_eq.T @ found.eqlin.marginals
        value += float(b_eq @ found.eqlin.marginals) - float(np.sum(np.abs(found.eqlin.marginals) * loose))
    lower, upper = np.maximum(lower, -most), np.minimum(upper, most)
    return value + float(np.sum(np.where(reduced > 0, reduced * lower, reduced * upper)))


def _tail(problem: TrackingProblem) -> int:
    """Samples until plant and weight have died out to rounding."""
    from .problem import roots_of

    radius = [1 / np.abs(roots_of(p)).min() for p in (problem.factors()[1], problem.weight[1]) if len(np.trim_zeros(p)) > 1]
    slowest = max([r for r in radius if r > 0], default=0.0)
    return int(min(MOST_TAIL, np.ceil(np.log(1e-13) / np.log(slowest)) + 10)) if 0 < slowest < 1 else 10


def design(problem: TrackingProblem = None, taps: int = 40) -> Design:
    """The l1-optimal controller: min ||e <- (r0, w0)|| with ||u <- (r0, w0)|| <= u_bar and ||z <- v|| <= 1 (T&B Sec. 4.2).

    Returns a `Design` whose norms are re-evaluated from Q, whose `gamma` is an upper and whose `lower` is a certified
    lower bound. Raises `ConfigurationError` where no controller keeps the rows, with the smallest u_bar that can be kept.
    """
    import scipy.signal  # noqa: F401  (its first import is no part of the time told)

    from .lower import lower_bound

    problem = TrackingProblem() if problem is None else problem
    if not 4 <= taps <= MOST_TAPS:
        raise ConfigurationError(f"taps = {taps}; give 4 to {MOST_TAPS} (40 suffice for the problem of T&B)")
    begin = time.perf_counter()
    full = Channels(problem, taps, taps + _tail(problem))
    for slack in (BACK_OFF, 4 * BACK_OFF, 16 * BACK_OFF):
        found, _ = programme(full, problem.u_bar, slack)
        if found.status == 2:
            _refuse(full, problem)
        if found.status != 0:
            raise ConfigurationError(f"the linear programme ended with: {found.message}; scale the problem or change taps")
        x = full.exact(found.x[: full.columns])
        norms = full.norms(x)
        if norms["control_r"] + norms["control_w"] <= problem.u_bar and norms.get("robust", 0.0) <= 1:
            break
    gamma, lower = norms["error_r"] + norms["error_w"], 0.0
    for rows in (taps, 2 * taps, 4 * taps):  # the taps may be enough and the rows not
        lower = max(lower, lower_bound(problem, rows, gamma))
        if gamma - lower <= CLOSE * gamma:
            break
    if not full.unstable:
        return Design(problem, x, gamma, lower, norms, time.perf_counter() - begin)
    # K = d_s X / V without the unstable poles that Q/(1 - lambda G_a Q) would cancel
    pair = (np.convolve(problem.factors()[1], x[:taps]), x[taps:])
    return Design(problem, (full.q @ x)[: taps + 8], gamma, lower, norms, time.perf_counter() - begin, pair)


def _refuse(channels, problem):
    least, _ = programme(channels, np.inf, 0.0, minimum_control=True)
    if least.status == 0:
        raise ConfigurationError(
            f"u_bar = {problem.u_bar:.6g} M_s^2 cannot be kept by any stabilizing controller; "
            f"the smallest feasible u_bar is {least.fun * (1 + 1e-6):.6g}"
        )
    raise ConfigurationError("robust stability cannot be reached for this plant and weight; lower c_w (the model's uncertainty)")


def knee(problem: TrackingProblem) -> tuple[float, float]:
    """(u_bar*, gamma_flat) of a minimum-phase plant: Q = 1/g, beyond which the saturation row plays no part.

    gamma_flat = w_bar ||(1 - lambda^2) G_a||_1 and u_bar* = w_bar + r_bar ||1/g||_1.
    """
    n, d = (np.asarray(p, float) for p in problem.plant)
    from .problem import roots_of

    if len(np.trim_zeros(n)) > 1 and np.abs(roots_of(n)).min() <= 1:
        raise ConfigurationError("the plant is not minimum phase: 1/g is unstable and there is no closed form; call design")
    g = response(n, d, 4000)
    G = np.append(0.0, g)
    flat = problem.w_bar * np.abs(G - np.concatenate([[0, 0], G[:-2]])).sum()
    return problem.w_bar + problem.r_bar * np.abs(response(d, n, 4000)).sum(), flat
