"""From a design to a controller: state space, reduction with the hard rows re-checked, margins, anti-windup.

K = Q/(1 - lambda G_a Q) is built as Q in positive feedback with the model lambda G_a (internal model control): the
model may be fed the control that the amplifier really delivers, and then nothing winds up.
"""

import dataclasses

import numpy as np
from scipy.linalg import cholesky, solve_discrete_lyapunov, svd

from ..errors import ConfigurationError
from .l1 import Design, TrackingProblem
from .problem import response

GUARD = 1e-9  # a reduced controller may exceed no hard row by more than rounding


@dataclasses.dataclass(frozen=True)
class Margins:
    """Of the loop lambda K G_a. `gain`, `phase` (deg), `modulus` = 1/||S||_inf; `delay`: extra whole samples borne."""

    gain: float
    phase: float
    modulus: float
    delay: int

    def __str__(self):
        return (
            f"gain margin {self.gain:.3g}, phase margin {self.phase:.3g} deg, modulus margin {self.modulus:.3g}, "
            f"bears {self.delay} extra samples of delay"
        )


def state_space(numerator, denominator):
    """(A, B, C, D) of a rational function in lambda, controllable form."""
    n = max(len(numerator), len(denominator), 2) - 1  # a constant keeps one idle state
    num = np.zeros(n + 1)
    den = np.zeros(n + 1)
    num[: len(numerator)], den[: len(denominator)] = numerator, denominator
    num, den = num / den[0], den / den[0]
    A = np.zeros((n, n))
    A[0] = -den[1:]
    A[np.arange(1, n), np.arange(n - 1)] = 1.0
    B = np.zeros((n, 1))
    B[0] = 1.0
    return A, B, (num[1:] - num[0] * den[1:])[None], np.array([[num[0]]])


def reduce(taps, order: int):
    """Balanced truncation of an FIR filter to `order` states: (A, B, C, D)."""
    A, B, C, D = state_space(np.asarray(taps, float), np.array([1.0]))
    P = solve_discrete_lyapunov(A, B @ B.T)
    Q = solve_discrete_lyapunov(A.T, C.T @ C)
    jitter = 1e-14 * np.eye(len(A))
    R = cholesky(P + jitter * np.trace(P), lower=True)
    U, s, _ = svd(R.T @ Q @ R)
    T = (R @ U) / np.sqrt(np.sqrt(np.maximum(s, 1e-300)))
    Ti = np.linalg.pinv(T)
    keep = slice(0, order)
    return (Ti @ A @ T)[keep, keep], (Ti @ B)[keep], (C @ T)[:, keep], D


def _trim(polynomial):
    polynomial = np.asarray(polynomial, float)
    return np.trim_zeros(np.where(np.abs(polynomial) > 1e-11 * np.abs(polynomial).max(), polynomial, 0.0), "b")


def impulse(system, count: int) -> np.ndarray:
    """First `count` samples of the impulse response of (A, B, C, D), one input, one output."""
    A, B, C, D = system
    x = B[:, 0].copy()
    y = np.empty(count)
    y[0] = D[0, 0]
    for k in range(1, count):
        y[k] = C[0] @ x
        x = A @ x
    return y


def norms_of(problem: TrackingProblem, q) -> dict:
    """l1 norms of the closed loop for the impulse response q of Q (stable plants)."""
    n, d, _ = problem.factors()
    count = len(q)
    g = response(n, d, count)
    G = np.append(0.0, g)[:count]
    lG = np.append(0.0, G)[:count]
    W = response(*problem.weight, count)
    loop = np.convolve(lG, q)[:count]
    square = np.zeros(count)
    square[2] = problem.r_bar
    sensitivity = -loop
    sensitivity[0] += 1.0
    found = {
        "error_r": np.abs(square - problem.r_bar * loop).sum(),
        "error_w": problem.w_bar * np.abs(np.convolve(G, sensitivity)[:count]).sum(),
        "control_r": problem.r_bar * np.abs(q).sum(), "control_w": problem.w_bar * np.abs(loop).sum(),
        "robust": np.abs(np.convolve(W, q)[:count]).sum(),
    }  # fmt: skip
    return {k: float(v) for k, v in found.items()}


class Controller:
    """A realized design: Q of a given order and the internal model. `order`: states of Q; `norms`: re-evaluated."""

    def __init__(self, design: Design, order: int | None = None):
        self.design, self.problem = design, design.problem
        n, d_s, d_u = design.problem.factors()
        if len(d_u) > 1 and order is not None:
            raise ConfigurationError("only designs for stable plants are reduced; leave order out")
        self.direct = None if design.pair is None else state_space(*(_trim(p) for p in design.pair))
        taps = np.trim_zeros(np.where(np.abs(design.Q) > 1e-12 * np.abs(design.Q).max(), design.Q, 0.0), "b")
        self.Q = state_space(taps, np.array([1.0])) if order is None else reduce(taps, order)
        self.order = len(self.Q[0])
        self.model = state_space(np.concatenate([[0.0, 0.0], n]), np.convolve(d_s, d_u))
        self.norms = norms_of(design.problem, impulse(self.Q, 4000)) if len(d_u) == 1 else dict(design.norms)
        self.reset()

    def breaks(self) -> list[str]:
        """Hard rows that this realization exceeds, in words; empty where none."""
        rows = []
        control = self.norms["control_r"] + self.norms["control_w"]
        if control > self.problem.u_bar * (1 + GUARD):
            rows.append(f"control {control:.6g} > u_bar = {self.problem.u_bar:.6g} M_s^2")
        if self.problem.robust and self.norms["robust"] > 1 + GUARD:
            rows.append(f"robust stability {self.norms['robust']:.6g} > 1")
        return rows

    @property
    def gamma(self) -> float:
        """Guaranteed peak of the tracking error, um."""
        return self.norms["error_r"] + self.norms["error_w"]

    def reset(self):
        """Forget the past."""
        self._k = np.zeros(0 if self.direct is None else len(self.direct[0]))
        self._q, self._m = np.zeros(len(self.Q[0])), np.zeros(len(self.model[0]))

    def step(self, error: float, limit: float = np.inf, anti_windup: bool = True) -> float:
        """One sample: tracking error (um) in, control (M_s^2) out, clipped to +-limit.

        `anti_windup`: the internal model is fed the clipped control, so that the loop closes round what the amplifier does.
        """
        if self.direct is not None:  # an unstable plant: K itself, no model to cancel against
            A, B, C, D = self.direct
            u = float(C[0] @ self._k + D[0, 0] * error)
            self._k = A @ self._k + B[:, 0] * error
            return min(max(u, -limit), limit)
        A, B, C, D = self.Q
        Am, Bm, Cm, _ = self.model  # lambda G_a has no direct term
        e = error + float(Cm[0] @ self._m)
        u = float(C[0] @ self._q + D[0, 0] * e)
        clipped = min(max(u, -limit), limit)
        self._q = A @ self._q + B[:, 0] * e
        self._m = Am @ self._m + Bm[:, 0] * (clipped if anti_windup else u)
        return clipped

    def to_control(self):
        """K as a python-control StateSpace with named signals, sampled at T."""
        import control

        dt = self.problem.T
        if self.direct is None:
            K = control.feedback(control.ss(*self.Q, dt), control.ss(*self.model, dt), sign=1)
        else:
            K = control.ss(*self.direct, dt)
        return control.ss(K.A, K.B, K.C, K.D, dt, inputs=["error_um"], outputs=["control_Ms2"], name="K")

    def margins(self, count: int = 20000) -> Margins:
        """Gain, phase, modulus and delay margins of the loop lambda K G_a."""
        w = np.linspace(1e-4, np.pi, count)
        G = self._at(self.model, w)
        if self.direct is None:
            lam = np.exp(-1j * w)
            q = np.polynomial.polynomial.polyval(lam, impulse(self.Q, 4000)) if self.order > 60 else self._at(self.Q, w)
            S = 1 - G * q
        else:
            S = 1 / (1 + G * self._at(self.direct, w))
        L = 1 / S - 1
        size = np.abs(L)
        cross = np.flatnonzero((size[1:] - 1) * (size[:-1] - 1) < 0)
        turned = np.flatnonzero((L.imag[1:] * L.imag[:-1] < 0) & (L.real[1:] < 0))
        gain = float(min((1 / size[k] for k in turned if size[k] < 1), default=np.inf))
        margin = float(min((abs(np.degrees(np.angle(-L[k]))) for k in cross), default=np.inf))
        return Margins(gain, margin, float(1 / np.abs(S).max()), self._delays())

    @staticmethod
    def _at(system, w):
        A, B, C, D = system
        values, vectors = np.linalg.eig(A)
        try:
            left, right = C @ vectors, np.linalg.solve(vectors, B)
            found = ((left[0] * right[:, 0])[None] / (np.exp(1j * w)[:, None] - values[None])).sum(axis=1) + D[0, 0]
            if np.linalg.cond(vectors) < 1e8:
                return found
        except np.linalg.LinAlgError:
            pass
        eye = np.eye(len(A))
        return np.array([(C @ np.linalg.solve(np.exp(1j * v) * eye - A, B))[0, 0] + D[0, 0] for v in w])

    def _delays(self, most: int = 20) -> int:
        """Extra whole samples of delay that the loop bears."""
        for extra in range(1, most + 1):
            if self._radius(extra) >= 1:
                return extra - 1
        return most

    def _radius(self, extra: int) -> float:
        """Spectral radius of the loop of K with the plant behind `extra` more delays."""
        if self.direct is not None:
            return self._radius_direct(extra)
        Aq, Bq, Cq, Dq = self.Q
        Am, Bm, Cm, _ = self.model
        nq, nm = len(Aq), len(Am)
        size = nq + 2 * nm + extra
        A = np.zeros((size, size))
        q, m, p, z = slice(0, nq), slice(nq, nq + nm), slice(nq + nm, nq + 2 * nm), slice(nq + 2 * nm, size)
        # e = -y + model; y = output of the true plant, delayed
        error = np.zeros((1, size))
        error[:, m] = Cm
        if extra:
            error[0, size - 1] -= 1.0
        else:
            error[:, p] -= Cm
        u = Dq @ error
        u[:, q] += Cq
        A[q] = Bq @ error
        A[q, q] += Aq
        A[m] = Bm @ u
        A[m, m] += Am
        A[p] = Bm @ u
        A[p, p] += Am
        if extra:
            A[z.start, p] = Cm[0]
            for k in range(z.start + 1, size):
                A[k, k - 1] = 1.0
        return float(np.abs(np.linalg.eigvals(A)).max())

    def _radius_direct(self, extra):
        Ak, Bk, Ck, Dk = self.direct
        Am, Bm, Cm, _ = self.model
        nk, nm = len(Ak), len(Am)
        A = np.zeros((nk + nm + extra, nk + nm + extra))
        y = np.zeros((1, len(A)))
        y[0, -1 if extra else slice(nk, nk + nm)] = 1.0 if extra else Cm
        u = -Dk @ y
        u[:, :nk] += Ck
        A[:nk] = -Bk @ y
        A[:nk, :nk] += Ak
        A[nk : nk + nm] = Bm @ u
        A[nk : nk + nm, nk : nk + nm] += Am
        for k in range(extra):
            A[nk + nm + k] = np.concatenate([np.zeros(nk), Cm[0], np.zeros(extra)]) if k == 0 else np.eye(len(A))[nk + nm + k - 1]
        return float(np.abs(np.linalg.eigvals(A)).max())


def reduced_controller(design: Design, tolerance: float = 1e-3) -> Controller:
    """The controller of lowest order whose gamma is within `tolerance` (relative) and that keeps every hard row.

    Where truncation makes u_bar or robustness slip, Q is scaled back until both hold. Falls back to the full order.
    """
    full = Controller(design)
    for order in range(1, min(full.order, 12) + 1):
        try:
            trial = Controller(design, order)
        except np.linalg.LinAlgError:
            continue
        control = trial.norms["control_r"] + trial.norms["control_w"]
        excess = max(control / design.problem.u_bar, trial.norms["robust"] if design.problem.robust else 0.0)
        if excess > 1:
            A, B, C, D = trial.Q
            trial.Q = (A, B, C / (excess * (1 + 1e-12)), D / (excess * (1 + 1e-12)))
            trial.norms = norms_of(design.problem, impulse(trial.Q, 4000))
        if np.abs(np.linalg.eigvals(trial.Q[0])).max() < 1 and not trial.breaks() and trial.gamma <= design.gamma * (1 + tolerance):
            return trial
    return full
