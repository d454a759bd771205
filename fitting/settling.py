"""How many periods a fit simulates until what it reads is settled.

Behind eddy currents H follows the current with a lag of mu_0 c0 N_m A_m chi / R_eddy, chi the slope of the loop; what the start leaves falls
by exp(-period / lag) with every period. At 70 ohm and 200 Hz that is gone after two. Of a rod of 40 ohm half is left of it by each at
450 Hz, and a model that is read after three has a loop of its own that no constants mend.
"""

import numpy as np

from .finer import REFINE_BELOW

REPEATS = 3e-4  # of the magnetization's peak to peak, that the last period may still be off
LADDER = (3, 8, 14, 24)  # periods simulated; few numbers, for a screening has programs of its own for each
ROUNDED = 1e-9  # of M: a loop that is no higher has none
MATTERS = 0.03  # of the misfit, that what has not settled may make up: physics that is left out may leave hundreds of times the noise
FALLS = 0.1, 0.95  # what is left falls to at least and at most so much of itself by a period: of three alone one knows it poorly


def periods_asked(problem, z, chi2=None) -> tuple[int, ...]:
    """Periods to simulate of each recording: of the LADDER what the magnetization of one takes to settle at z, where what is left makes
    up a part of `chi2` there (None: the misfit at z) that counts: of the noise's own where a finer density may come to it. All that take
    more than the least take those of the slowest. A fit to what had not settled has bent to it, and tells no more than that it takes
    longer."""
    periods = problem.predictors[0].periods_of_each
    rows = [left(M) for M in problem.passes.magnetizations(z)]
    off = np.array([row[0] for row in rows])
    late = off > REPEATS
    if late.any():
        chi2 = float(np.sum(problem.passes.residual(z) ** 2)) if chi2 is None else chi2
        chi2 = chi2 if chi2 > REFINE_BELOW * problem.data_count else problem.data_count
        late &= (2 * off) ** 2 * _power(problem.target) > MATTERS * chi2  # strain goes by M^2
    asked = [_longer(n, *row) if unsettled else n for n, row, unsettled in zip(periods, rows, late, strict=True)]
    return tuple(n if n <= LADDER[0] else max(asked) for n in asked)


def _power(target):
    """Of each reading's lines but its mean, in their deviations, (recordings,)."""
    return np.sum(np.abs(np.asarray(target.lines)[:, 1:] / np.asarray(target.deviations)[:, 1:]) ** 2, axis=1)


def _longer(periods, off, falls) -> int:
    more = [n for n in LADDER if n > periods] or [periods]
    return next((n for n in more if off * falls ** (n - periods) <= REPEATS), more[-1])


def left(magnetization) -> tuple[float, float]:
    """How far the last of (periods, samples) is from where they lead to, over the peak to peak, and how much of that a period leaves: two
    changes tell."""
    *before, last = np.abs(np.diff(magnetization, axis=0)).max(axis=1)
    lowest, highest = FALLS
    falls = min(max(last / before[-1], lowest), highest) if before and before[-1] > 0 else lowest if before else 0.5
    height = max(np.ptp(magnetization[-1]), ROUNDED * np.abs(magnetization).max(), 1e-300)
    return float(min(last * falls / (1 - falls) / height, 1.0)), float(falls)
