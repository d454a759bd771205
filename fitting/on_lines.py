"""What is added to the reading and repeats with the drive, so that no repeat shows it: a sensor's zero, hum on a harmonic.

Scored as the effects are: off everything that the base can do (`screen.Projector`).
"""

from typing import NamedTuple

import numpy as np

from .record_level import HUM_TONES, MAINS, pulsation_lines
from .screen import Projector

SAME_SIZE = 0.8  # of what tones of any size in each recording would take, that those of one size must


class HeatScore(NamedTuple):
    """`z` of the pulsation, its `rate` and standard error, m/(A^2 s), the `zeros` beside it with theirs, m, the `fall` of chi2 by all."""

    z: float
    rate: float
    stderr: float
    zeros: np.ndarray
    zero_errors: np.ndarray
    fall: float


def offset_score(problem, solution) -> float:
    """z of a constant added to every reading, beside everything the base can do."""
    projector = Projector(problem, solution)
    part = _projected(problem, projector, [(slice(None), 0, 1.0)])[:, 0]
    return float(-(part @ projector.residual) / max(np.linalg.norm(part), 1e-300))


def zeros_score(problem, solution):
    """A zero of its own in every reading, beside everything the base can do: (z of the scale of one column's, zeros, their
    standard errors; unit of the reading)."""
    projector = Projector(problem, solution)
    columns = _projected(problem, projector, [(n, 0, 1.0) for n in range(len(problem.spectra))])
    zeros, *_ = np.linalg.lstsq(columns, -projector.residual, rcond=1e-6)
    fall = float(projector.residual @ projector.residual - np.sum((projector.residual + columns @ zeros) ** 2))
    return float(np.sqrt(max(fall - len(zeros), 0.0))), zeros, _errors(columns)


def _errors(columns):
    """Standard errors of the sizes of columns."""
    return np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns, rcond=1e-12)))


def hum_score(problem, solution):
    """Hum where it falls on harmonics of the drive, beside everything the base can do: each tone has one amplitude, and a
    phase of its own in each recording. What a rough density leaves there, or a single recording, has no size in common.

    Returns, of the mains frequency that explains more: the score z, of the same scale as one column's, and its tones
    (frequency, Hz, and amplitude); (0, ()) where no harmonic falls on one, or sizes differ.
    """
    projector = Projector(problem, solution)
    best = 0.0, ()
    for mains in MAINS:
        places = _on_harmonics(problem, mains)
        if not places:
            continue
        columns = _projected(problem, projector, [(n, h, part) for n, h, _ in places for part in (1.0, 1j)])
        size, *_ = np.linalg.lstsq(columns, -projector.residual, rcond=1e-6)
        phases = size.reshape(-1, 2) / np.maximum(np.hypot(size[::2], size[1::2]), 1e-300)[:, None]
        orders = np.asarray([k for _, _, k in places])
        own = np.stack([columns @ (phases * (orders == k)[:, None]).ravel() for k in range(1, HUM_TONES + 1)], axis=1)
        alike, *_ = np.linalg.lstsq(own, -projector.residual, rcond=1e-6)
        free, fall = (
            float(projector.residual @ projector.residual - np.sum((projector.residual + x) ** 2))
            for x in (columns @ size, own @ alike)
        )
        z = float(np.sqrt(max(fall - len(size) / 2, 0.0)))
        if z > best[0] and fall > SAME_SIZE * free:
            best = z, tuple((k * mains, 2 * float(a)) for k, a in enumerate(alike, 1))
    return best


def heat_score(problem, solution, zeros: bool = False) -> HeatScore:
    """The pulsation of the heat within the period (`record_level.pulsation_lines`), of one rate for all recordings, beside
    everything the base can do; `zeros`: beside a zero of each recording, too, which began as warm as it was.
    """
    projector = Projector(problem, solution)
    lines = np.zeros(problem.target.lines.shape, complex)
    for row, s in zip(lines, problem.spectra, strict=True):
        own = pulsation_lines(s)[: len(row)]
        row[: len(own)] = own
    column, residual = projector.project(problem.passes.change(lines)), projector.residual
    beside = _projected(problem, projector, [(n, 0, 1.0) for n in range(len(problem.spectra))] if zeros else [])
    left = column - beside @ np.linalg.lstsq(beside, column, rcond=1e-6)[0]
    power = max(float(left @ left), 1e-300)
    rate = -float(left @ residual) / power
    levels = np.linalg.lstsq(beside, -residual - rate * column, rcond=1e-6)[0]
    fall = residual @ residual - np.sum((residual + rate * column + beside @ levels) ** 2)
    return HeatScore(rate * np.sqrt(power), rate, 1 / np.sqrt(power), levels, _errors(beside), float(fall))


def _on_harmonics(problem, mains):
    """(recording, harmonic, multiple of the mains) wherever a tone of the hum and a harmonic cannot be told apart."""
    places = []
    for n, s in enumerate(problem.spectra):
        for k in range(1, HUM_TONES + 1):
            h = round(k * mains / s.frequency)
            if 1 <= h < problem.target.lines.shape[1] and abs(h * s.frequency - k * mains) < 0.6 * s.frequency / s.periods:
                places.append((n, h, k))
    return places


def _projected(problem, projector, signals):
    """Columns of unit signals at (recording, harmonic, complex amplitude), off the tangent space: (rows, signals)."""
    rows = []
    for recording, harmonic, amplitude in signals:
        lines = np.zeros(problem.target.lines.shape, complex)
        lines[recording, harmonic] = amplitude
        rows.append(projector.project(problem.passes.change(lines)))
    return np.stack(rows, axis=1) if rows else np.zeros((len(projector.residual), 0))

