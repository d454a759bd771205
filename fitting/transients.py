"""Records that begin unsettled: the decaying motion of the mechanics, found between the harmonics and taken out.

A record that starts before the rod has settled holds, beside the steady state, a solution of T&B (5) without drive,
exp(-xi w0 t) (a cos wd t + b sin wd t): two numbers a recording, one pair of poles for all. Three quarters of it (four
periods) lie between the harmonics, where nothing else is. The poles are sought about the bench's; what decays otherwise
(drift, magnetic memory, heat) is left in the record, for the gates of the diagnosis.
"""

import dataclasses

import numpy as np
from scipy.optimize import minimize

from .spectra import estimate_noise, fit_lines

SEEN = 40.0  # fall of chi2 by two columns from which a start counts as unsettled
SHARE = 0.5  # of what exceeds the noise between the harmonics; less is another cause
F0_FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
DAMPINGS = (0.03, 0.2, 0.6, 1.2)


def free_motion(f0: float, xi: float, dt: float, count: int) -> np.ndarray:
    """T&B (5) without drive, from y = 1, y' = -xi w0 and from y = 0, y' = w0: two columns over time, (2, count)."""
    w0 = 2 * np.pi * f0
    root = np.sqrt(complex(xi * xi - 1.0)) if abs(xi - 1) > 1e-6 else 1e-3
    short = min(count, int(60 / (w0 * max((xi - root).real if np.isreal(root) else xi, 1e-3) * dt)) + 2)
    t = dt * np.arange(short)
    fast, slow = np.exp(w0 * (-xi - root) * t), np.exp(w0 * (-xi + root) * t)
    columns = np.zeros((2, count))
    columns[:, :short] = (0.5 * (fast + slow)).real, ((slow - fast) / (2 * root)).real
    return columns


@dataclasses.dataclass(frozen=True)
class _Gaps:
    """What lies between the harmonics of one recording: whitening of its bins, and the reading there."""

    dt: float
    samples: int
    bins: np.ndarray
    scale: np.ndarray
    reading: np.ndarray

    @staticmethod
    def of(s, density) -> "_Gaps":
        f = np.fft.rfftfreq(s.samples, s.dt)
        bins = np.flatnonzero(np.isin(f, s.between_f))
        scale = np.sqrt(2.0 / (s.samples * density(f[bins])))
        return _Gaps(s.dt, s.samples, bins, scale, np.fft.rfft(s.residue)[bins] * scale)

    def take(self, f0, xi):
        """(fall of chi2, the two numbers) of the best free motion with these poles."""
        X = np.fft.rfft(free_motion(f0, xi, self.dt, self.samples))[:, self.bins] * self.scale
        G, g = (X @ X.conj().T).real, (X.conj() @ self.reading).real
        best = np.linalg.solve(G + 1e-9 * np.trace(G) * np.eye(2), g)
        return float(g @ best), best

    @property
    def excess(self) -> float:
        """By how much chi2 exceeds what noise alone leaves, less its scatter."""
        return float(np.sum(np.abs(self.reading) ** 2)) - 2 * len(self.bins) - 8 * np.sqrt(len(self.bins))


def _white(s):
    """White noise by the median of the upper half of the bins, which a slow transient does not reach."""
    upper = s.between_power[s.between_f > np.median(s.between_f)]
    level = max(float(np.median(upper)) / np.log(2), 1e-300)
    return lambda f: np.full(len(f), level)


def _later_noise(spectra):
    """The noise of the later halves of the records, or None where none holds two periods.

    By frequency: a decay that goes by periods and not by time, which is no free motion, would pass for noise by the rate.
    """
    halves = []
    for s in spectra:
        if s.periods < 4:
            continue
        skip = s.samples // 2
        phases = s.dt * s.frequency * np.arange(s.samples - skip)
        residue = fit_lines(s.residue[skip:], phases, len(s.reading) - 1)[1]
        f = np.fft.rfftfreq(len(residue), s.dt)
        order = f / s.frequency
        keep = (f > 0) & (np.abs(order - np.round(order)) > 0.3)
        power = np.abs(np.fft.rfft(residue)) ** 2 / len(residue)
        halves.append(dataclasses.replace(s, between_f=f[keep], between_power=power[keep], residue=residue))
    return estimate_noise(halves) if halves else None


def unsettled_starts(spectra, f0: float) -> list:
    """For each spectrum the decaying start over its samples, unit of the reading, or None; `f0`: about where, Hz."""
    nothing = [None] * len(spectra)
    usable = [k for k, s in enumerate(spectra) if s.periods >= 2 and len(s.between_f) >= 40]
    gaps = [_Gaps.of(spectra[k], _white(spectra[k])) for k in usable]
    trials = [(f0 * a, b) for a in F0_FACTORS for b in DAMPINGS]

    def falls(poles):
        return [g.take(*poles)[0] for g in gaps]

    scores = [falls(p) for p in trials] if gaps else []
    if not scores or np.max(scores) < SEEN:
        return nothing
    later = _later_noise([spectra[k] for k in usable])
    if later is not None:
        gaps = [_Gaps.of(spectra[k], later.density) for k in usable]
        scores = [falls(p) for p in trials]

    def missed(logs):
        return -sum(falls(np.exp(logs)))

    start = np.log(trials[int(np.argmax(np.sum(scores, axis=1)))])
    poles = np.exp(minimize(missed, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-2, "maxiter": 120}).x)
    if not 0.4 * f0 < poles[0] < 2.5 * f0 or not 5e-3 < poles[1] < 1.6:
        return nothing
    found = nothing
    for k, g in zip(usable, gaps, strict=True):
        fall, numbers = g.take(*poles)
        if fall > SEEN and fall > SHARE * g.excess:
            found[k] = numbers @ free_motion(*poles, g.dt, g.samples)
    return found
