"""Instruments judged by themselves: linear laws fitted to what comes out over what goes in, at single frequencies.

The amplifier: measured current over command. The sensor: its reading over a known displacement. No model of the rod is
needed. Laws: first-order lag 1/(1 + s tau), filter 1/(1 + s tau + order2 (s tau)^2), delay exp(-s tau), each times a gain.
"""

import dataclasses

import numpy as np
from scipy.optimize import least_squares

Z_FOUND = 6.0  # of tau: below it the instrument follows
RIVAL = 10.0  # of chi2: nearer laws are not told apart


def _lag(s, tau):
    return 1 / (1 + s * tau)


def _filter(s, tau, order2):
    return 1 / (1 + s * tau + order2 * (s * tau) ** 2)


def _delay(s, tau):
    return np.exp(-s * tau)


# law -> (function of s and its parameters, names of the parameters, starts in units of 1 / highest w)
SOURCE_LAWS = {"amplifier_lag": (_lag, ("tau",), (0.01,)), "delay": (_delay, ("tau",), (0.01,))}
SENSOR_LAWS = {"sensor_lag": (_filter, ("tau", "order2"), (0.3, 0.3)), "transport_delay": (_delay, ("tau",), (0.01,))}


@dataclasses.dataclass(frozen=True)
class LawFit:
    """A law fitted to gains: `parameters`: name -> (value, standard error), SI; `gain` at rest; `chi2` over `numbers`."""

    law: str
    parameters: dict
    gain: float
    chi2: float
    numbers: int

    @property
    def z(self) -> float:
        """tau in its standard errors."""
        value, error = self.parameters["tau"]
        return value / error


def fit_laws(w, gain, error, laws) -> dict[str, LawFit]:
    """Every law fitted to complex gains at angular frequencies `w`, rad/s, with errors of their parts: law -> `LawFit`.

    Standard errors are widened by the root of chi2 per number where that is above one.
    """
    return {name: _fit(name, w, gain, error, *law) for name, law in laws.items()}


def _fit(name, w, gain, error, law, names, starts) -> LawFit:
    scale = 1 / w.max()

    def values(x):
        return [x[1] * scale, *x[2:]]

    def residual(x):
        miss = (x[0] * law(1j * w, *values(x)) - gain) / error
        return np.concatenate([miss.real, miss.imag])

    low = [-np.inf, -np.inf, *[0.0] * (len(starts) - 1)]
    result = least_squares(residual, [float(np.abs(gain).max()), *starts], x_scale=1e-2, bounds=(low, np.inf))
    covariance = np.linalg.pinv(result.jac.T @ result.jac)
    chi2 = float(2 * result.cost)
    numbers = max(2 * len(w) - 1 - len(starts), 1)
    errors = np.sqrt(np.diag(covariance)[1:] * max(chi2 / numbers, 1.0)) * np.array([scale, *[1.0] * (len(starts) - 1)])
    pairs = zip(names, zip(values(result.x), errors, strict=True), strict=True)
    return LawFit(name, {n: (float(v), float(e)) for n, (v, e) in pairs}, float(result.x[0]), chi2, numbers)


def judge_source(w, gain, error) -> tuple[str, LawFit, float]:
    """As `judge_laws` for an amplifier; a filter of second order where neither lag nor delay will do."""
    verdict, best, rival = judge_laws(fit_laws(w, gain, error, SOURCE_LAWS))
    if verdict in ("unknown", "delay") and len(w) > 2:
        wider = _fit("amplifier_lag", w, gain, error, *SENSOR_LAWS["sensor_lag"])
        if wider.chi2 < best.chi2 - RIVAL and wider.chi2 < 25 * wider.numbers + 50 and wider.z > Z_FOUND:
            return "amplifier_lag", wider, best.chi2
    return verdict, best, rival


def judge_laws(fits: dict[str, LawFit]) -> tuple[str, LawFit, float]:
    """(verdict, the best law, chi2 of its rival): verdict "follows", a law's name, "group" (laws not told apart) or "unknown"."""
    ranked = sorted(fits.values(), key=lambda f: f.chi2)
    best, rival = ranked[0], ranked[-1].chi2
    if max(abs(f.z) for f in ranked if len(f.parameters) == 1) < Z_FOUND:
        return ("follows" if best.chi2 < 5 * best.numbers + 20 else "unknown"), best, rival
    if best.chi2 > 25 * best.numbers + 50:
        return "unknown", best, rival
    return (best.law if rival - best.chi2 > RIVAL else "group"), best, rival
