"""The form of a law that is linear in the reading: whatever a filter is left to do that another law of its kind would do.

A lag, a mode, a loss of the spring: each is one filter of the reading, known by its law to a part of a hundred or so. What any other filter
would change of the lines is a gain, smooth in log f, for each of them; what that cannot make is no form of those laws.
"""

import numpy as np

from .screen import Projector

# effects that are a linear filter of the reading
FILTERS = ("sensor_lag", "transport_delay", "second_mode", "structural_damping", "creep")
PER_DECADE = 4  # knots of a free filter


def free_filter(result) -> np.ndarray:
    """First-order change of the whitened misfit of a fit by a free linear filter of the reading: (columns, data), of hats in log f, real and
    imaginary, over the lines that stand above their deviations."""
    problem = result.problem
    lines = problem.passes.lines(result.refined.z, problem.predictors[1])
    f = np.array([s.frequency for s in problem.spectra])[:, None] * np.arange(lines.shape[1])
    seen = (f > 0) & (np.abs(lines) > problem.passes.target.deviations)
    logs = np.log10(np.where(f > 0, f, 1.0))
    low, high = logs[seen].min(), logs[seen].max()
    count = max(int(np.ceil(PER_DECADE * (high - low))) + 1, 2)
    place = np.clip((logs - low) / max(high - low, 1e-9) * (count - 1), 0, count - 1)
    hats = np.maximum(1 - np.abs(place - np.arange(count)[:, None, None]), 0) * seen
    return problem.passes.change(np.concatenate([hats * lines, 1j * hats * lines]))


def filter_takes(result) -> float:
    """The fall of chi2, to first order, that a free linear filter of the reading promises beside a fit."""
    projector = Projector(result.problem, result.refined)
    parts = np.stack([projector.project(c) for c in free_filter(result)], axis=1)
    parts = parts[:, np.linalg.norm(parts, axis=0) > 0]
    if not parts.shape[1]:
        return 0.0
    basis, sizes, _ = np.linalg.svd(parts / np.linalg.norm(parts, axis=0), full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes[0]]
    return float(np.sum((basis.T @ projector.residual) ** 2))
