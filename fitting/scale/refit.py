"""A fit that begins at its optimum: what resamples and profiles repeat thousands of times.

A Jacobian near the optimum serves for several steps (the chord method): a step costs one simulation, not a Jacobian.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..joint import Problem, data_jacobian, data_residual, data_residuals, prior_matrix
from ..solver import cost_of, damped_step

BATCH = 10  # refits side by side: twice as many are slower, a draw, for their Everett tables leave the cache
CHORDS = 6  # steps with one Jacobian
DAMPING = 1e-9  # at first: none
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
    bounds = problem.layout.bounds
    prior = prior_matrix(problem, weights)
    z = np.asarray(z, float)
    residual = data_residual(problem, z)
    cost = cost_of(residual, z, prior)
    taken, converged, damping = 0, False, DAMPING
    while True:
        fresh = jacobian is None
        if fresh:
            jacobian, taken = data_jacobian(problem, z), taken + 1
        normal = jacobian.T @ jacobian + prior
        for step in range(CHORDS):
            gradient = jacobian.T @ residual + prior @ z
            new, predicted = damped_step(normal, gradient, z, damping, bounds)
            trial = data_residual(problem, new)
            new_cost = cost_of(trial, new, prior)
            good, converged = _verdict(cost, new_cost, predicted)
            if good:
                z, residual, cost = new, trial, new_cost
            if converged or not good:
                damping = damping if good or not (fresh and step == 0) else max(100 * damping, 1e-4)
                break
        if converged or taken == jacobians:
            return Settled(z, float(residual @ residual), cost, taken, converged, jacobian)
        jacobian = None


def settle_each(problem: Problem, lines, z, weights, jacobian) -> list[Settled]:
    """`settle` for each row of `lines`, (draws, recordings, harmonics + 1), from one z and one Jacobian, BATCH at a time.

    A batch takes its steps together, one simulation of all; where the Jacobian does not serve a draw it goes on by itself. A
    last batch is filled up, so that a draw's numbers do not depend on how many there are.
    """
    bounds, prior = problem.layout.bounds, prior_matrix(problem, weights)
    normal = jacobian.T @ jacobian + prior
    ended = []
    for first in range(0, len(lines), BATCH):
        own = lines[first : first + BATCH]
        filled = np.concatenate([own, np.repeat(own[-1:], BATCH - len(own), axis=0)])
        ended += _chords(problem, filled, np.tile(np.asarray(z, float), (BATCH, 1)), prior, normal, jacobian, bounds)[: len(own)]
    return [s if s.converged else settle(with_lines(problem, row), s.z, weights) for s, row in zip(ended, lines, strict=True)]


def _chords(problem, lines, z, prior, normal, jacobian, bounds):
    """Steps with one Jacobian, each draw until it has settled or a step has not kept its promise."""
    residual = np.array(data_residuals(problem, z, lines))
    cost = [cost_of(*both, prior) for both in zip(residual, z, strict=True)]
    going, converged = np.ones(len(z), bool), np.zeros(len(z), bool)
    for _ in range(CHORDS):
        new, predicted = z.copy(), np.zeros(len(z))
        for k in np.flatnonzero(going):
            new[k], predicted[k] = damped_step(normal, jacobian.T @ residual[k] + prior @ z[k], z[k], DAMPING, bounds)
        trial = data_residuals(problem, new, lines)
        for k in np.flatnonzero(going):
            new_cost = cost_of(trial[k], new[k], prior)
            good, converged[k] = _verdict(cost[k], new_cost, predicted[k])
            if good:
                z[k], residual[k], cost[k] = new[k], trial[k], new_cost
            going[k] = good and not converged[k]
        if not going.any():
            break
    rows = zip(z, residual, cost, converged, strict=True)
    return [Settled(own, float(r @ r), c, 0, bool(ok), jacobian) for own, r, c, ok in rows]


def _verdict(cost, new_cost, predicted) -> tuple[bool, bool]:
    """Whether a step is taken, and whether the refit has settled.

    The Jacobian is of a coarser grid: at the last digits its promise need not be kept.
    """
    good = bool(np.isfinite(new_cost) and cost - new_cost > 0.1 * predicted)
    return good, bool(predicted < SETTLED) or (not good and bool(predicted < 10 * SETTLED))
