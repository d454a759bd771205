"""The generalized plant of T&B Fig. 12 in the lambda domain, lambda = 1/z, and what the design asks of it.

    u = lambda K (y_ref - y);  u~ = u + w_bar w0;  y = G_a u~ + v;  v = Delta z;  z = W_0 u~;  G_a = lambda g
    e_t = lambda^2 y_ref - y;  y_ref = r_bar r0
One delay of the loop is the inversion's, one the plant's (Sec. 4.2). Lengths in um, u in units of M_s^2: in SI the
coefficients would range from 1e-16 to 1e12.
"""

import dataclasses

import numpy as np

from ..errors import ConfigurationError

M_S = 7.87e5
STROKE_UM = 5.13e-2 * 1.313e-3 * 1e6  # l_rod lambda_s, um per M_s^2, T&B Sec. 2.3
C_W_UM = 6.53e-13 * M_S**2  # T&B Figs. 14 and 15: um per (A/m)^2, here um per M_s^2


def response(numerator, denominator, count: int) -> np.ndarray:
    """First `count` coefficients of numerator/denominator as a power series in lambda."""
    from scipy.signal import lfilter

    impulse = np.zeros(count)
    impulse[0] = 1.0
    return lfilter(np.asarray(numerator, float), np.asarray(denominator, float), impulse)


def roots_of(polynomial) -> np.ndarray:
    """Roots of a polynomial in lambda, coefficients in rising powers."""
    return np.roots(np.trim_zeros(np.asarray(polynomial, float)[::-1], "f"))


def weight(c_w: float = C_W_UM):
    """W_0 = 1.1759 c_w (lambda - 1.0005)/(lambda - 1.1765) of T&B Sec. 4.3: (numerator, denominator)."""
    if not 0 <= c_w < np.inf:
        raise ConfigurationError(f"c_w = {c_w}; give the size of the uncertainty, zero or more")
    return 1.1759 * c_w * np.array([-1.0005, 1.0]), np.array([-1.1765, 1.0])


def rod(f0: float = 392.0, xi: float = 0.7783, T: float = 5e-4, gain: float = STROKE_UM):
    """The linear part (5) sampled with a hold: g of G_a = lambda g as (numerator, denominator) in lambda.

    `gain`: displacement per u, um per M_s^2.
    """
    if not (f0 > 0 and T > 0 and xi > 0):
        raise ConfigurationError(f"f0 = {f0} Hz, xi = {xi}, T = {T} s: all must be positive for a stable sampled rod")
    from scipy.signal import cont2discrete

    w = 2 * np.pi * f0
    numerator, denominator, _ = cont2discrete(([gain * w * w], [1.0, 2 * xi * w, w * w]), T, method="zoh")
    return np.asarray(numerator).ravel()[1:], np.asarray(denominator)


@dataclasses.dataclass(frozen=True)
class TrackingProblem:
    """What is to be designed. `plant`: g as (numerator, denominator) in lambda, um per M_s^2; `weight`: W_0 likewise.

    `r_bar`: largest reference, um; `w_bar`: largest inversion error, M_s^2; `u_bar`: saturation, M_s^2, inf for none;
    `T`: sample time, s; `robust`: keep the small-gain row ||z <- v|| <= 1.
    """

    plant: tuple = dataclasses.field(default_factory=rod)
    weight: tuple = dataclasses.field(default_factory=weight)
    r_bar: float = 30.0
    w_bar: float = 0.1
    u_bar: float = 3.25
    T: float = 5e-4
    robust: bool = True

    def __post_init__(self):
        for name in ("r_bar", "w_bar", "u_bar", "T"):
            value = getattr(self, name)
            if not value > 0 or (name != "u_bar" and value == np.inf):
                raise ConfigurationError(
                    f"{name} = {value}; give a positive value{' (inf for no limit)' if name == 'u_bar' else ''}"
                )
        if self.robust and np.any(np.abs(roots_of(self.weight[1])) <= 1):
            raise ConfigurationError("the weight W_0 is unstable (a pole with |lambda| <= 1); choose one with all poles outside")

    def factors(self):
        """(n, d_stable, d_unstable) with g = n / (d_stable d_unstable): a stabilizing factorization in polynomials.

        Raises `ConfigurationError` where there is none: a pole on the unit circle, or one that a zero cancels.
        """
        n, d = (np.asarray(p, float) for p in self.plant)
        if d[0] == 0:
            raise ConfigurationError(
                "the plant's denominator has no constant term in lambda: it is not causal; divide out the delay"
            )
        poles = roots_of(d)
        if np.any(np.abs(np.abs(poles) - 1) < 1e-9):
            raise ConfigurationError(
                f"the plant has a pole on the unit circle ({poles[np.argmin(np.abs(np.abs(poles) - 1))]:.6g}); "
                "no stabilizing factorization: add damping"
            )
        unstable = poles[np.abs(poles) < 1]
        zeros = roots_of(n) if len(np.trim_zeros(n)) > 1 else np.array([])
        for p in unstable:
            if abs(p) < 1e-12 or (len(zeros) and np.abs(zeros - p).min() < 1e-9):
                raise ConfigurationError(
                    f"the unstable pole at lambda = {p:.6g} is cancelled by a zero: no controller can stabilize this plant"
                )
        d_unstable = np.real(np.poly(1 / unstable)) if len(unstable) else np.array([1.0])
        d_stable, rest = np.polynomial.polynomial.polydiv(d, d_unstable)
        if np.abs(rest).max(initial=0.0) > 1e-8 * np.abs(d).max():
            raise ConfigurationError("the plant could not be factorized; scale its coefficients")
        return n, d_stable, d_unstable
