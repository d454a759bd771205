"""A fit that begins at its optimum: what resamples and profiles repeat thousands of times.

A Jacobian near the optimum serves for several steps (the chord method): a step costs one simulation, not a Jacobian.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..joint import Problem, data_jacobian, data_residual, prior_matrix
from ..solver import damped_step

CHORDS = 6  # steps with one Jacobian
SETTLED = 0.01  # predicted fall of half chi2 + prior: a tenth of a standard error of the worst direction


@dataclasses.dataclass(frozen=True)
class Settled:
    """Where a refit ended: unknowns, chi2 of the data, cost (half chi2 + prior), Jacobians taken, the last of them."""

    z: np.ndarray
    chi2: float
    cost: float
    jacobians: int
    converged: bool
    jacobian: np.ndarray


def lean(problem: Problem) -> Problem:
    """The problem without the recordings' samples, which no refit reads: little to send to a worker."""
    return dataclasses.replace(problem, spectra=())


def with_lines(problem: Problem, lines) -> Problem:
    """The same problem with other measured lines, (recordings, harmonics + 1) complex."""
    return dataclasses.replace(problem, target=eqx.tree_at(lambda t: t.lines, problem.target, jnp.asarray(lines)))


def settle(problem: Problem, z, weights, *, jacobian=None, jacobians: int = 4) -> Settled:
    """Minimise half chi2 + prior from a nearby z with the roughness weights held.

    `jacobian`: of the data at a point nearby, (data, unknowns), to begin with; `jacobians`: how many more may be taken.
    """
    bounded = jnp.asarray(problem.layout.nonnegative)
    prior = prior_matrix(problem, weights)
    z = np.asarray(z, float)
    residual = data_residual(problem, z)
    cost = 0.5 * float(residual @ residual + z @ prior @ z)
    taken, converged, damping = 0, False, 1e-9
    while True:
        fresh = jacobian is None
        if fresh:
            jacobian, taken = data_jacobian(problem, z), taken + 1
        normal = jacobian.T @ jacobian + prior
        for step in range(CHORDS):
            gradient = jacobian.T @ residual + prior @ z
            new, predicted = (np.asarray(v) for v in damped_step(normal, gradient, z, damping, bounded))
            trial = data_residual(problem, new)
            new_cost = 0.5 * float(trial @ trial + new @ prior @ new)
            good = bool(np.isfinite(new_cost) and cost - new_cost > 0.1 * predicted)
            if good:
                z, residual, cost = new, trial, new_cost
            # the Jacobian is of a coarser grid: at the last digits its promise need not be kept
            converged = bool(predicted < SETTLED) or (not good and bool(predicted < 10 * SETTLED))
            if converged or not good:
                damping = damping if good or not (fresh and step == 0) else max(100 * damping, 1e-4)
                break
        if converged or taken == jacobians:
            return Settled(z, float(residual @ residual), cost, taken, converged, jacobian)
        jacobian = None
