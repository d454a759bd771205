"""How many periods a fit simulates until what it reads is settled.

Behind eddy currents H follows the current with a lag of mu_0 c0 N_m A_m chi / R_eddy, chi the slope of the loop; what the start leaves falls
by exp(-period / lag) with every period. At 70 ohm and 200 Hz that is gone after two. Of a rod of 40 ohm half is left of it by each at
450 Hz, and a model that is read after three has a loop of its own that no constants mend.
"""

import numpy as np

REPEATS = 3e-4  # of the magnetization's peak to peak, by which the last two periods may differ
LADDER = (3, 6, 12, 24)  # periods simulated; few numbers, for each has programs of its own


def periods_asked(problem, z) -> int:
    """Periods to simulate: the next of the LADDER where the magnetization of a recording does not repeat itself at z. A fit to what
    had not settled has bent to it, and tells no more than that it takes longer."""
    periods = problem.predictors[0].periods
    settled = all(_change(M) <= REPEATS for M in problem.passes.magnetizations(z))
    return periods if settled else next((n for n in LADDER if n > periods), periods)


def _change(magnetization) -> float:
    """Between the last two periods of (periods, samples), over the peak to peak."""
    return float(np.abs(magnetization[-1] - magnetization[-2]).max() / max(np.ptp(magnetization[-1]), 1e-300))
