"""Densities with steps: blocks, ridges, random cells, of which second differences are nothing at most places and large at few.

One weight for all differences of a family, by evidence, is a normal law of them: to let the few stand it lets all of the plane go
rough, or smooths the steps away and leaves a misfit that looks like physics. Differences that follow Student's law instead have
a weight each, (nu + 1) / (nu + weight x difference^2) times that of the family, found by solving again with the weights of the
last solution (iteratively reweighted least squares: Charbonnier, Blanc-Feraud, Aubert and Barlaud, IEEE Trans. Image Processing
6, 298, 1997, call it edge-preserving regularization).
Of what physics leaves that takes little: 2 to 8 % of what is above the noise on smooth benches, most of a random density's.
"""

import dataclasses

import numpy as np

from .density import Stiffness
from .joint import solve

NU = 0.3  # degrees of freedom of Student's law: 0.1 to 1 foretell alike, 3 worse
ROUNDS, JACOBIANS, AT_LAST = 4, 5, 30  # of the weights, within each, and of a last one that has not settled; more rounds change little
GAINS = 0.1  # share of what is above the noise that the first round must take: what physics leaves stays
SETTLED = 2e-3  # share of chi2 that a round must move it by, to be followed by another


def stepped(problem, solution, progress=None):
    """A problem of one weight a family with a stiffness of each difference by itself instead, and its solution, from that of the
    problem as it is.

    Returns (problem, solution); those that were given where the misfit is none that steps of the density leave.
    """
    basis, count, n = problem.basis, problem.data_count, problem.layout.density_unknowns
    weights, ones, begun, first = solution.weights, np.ones(len(solution.weights)), problem, solution

    def gone_on(most):
        """The solution from where it stands, with what it took so far."""
        found = solve(problem, solution.z, ones, max_jacobians=most, progress=progress)
        spent = {"jacobians": solution.jacobians + found.jacobians, "seconds": solution.seconds + found.seconds}
        return dataclasses.replace(found, **spent)

    for _ in range(ROUNDS):
        factors = tuple((NU + 1) / (NU + w * (D @ solution.z[:n]) ** 2) for w, D in zip(weights, basis.penalties, strict=True))
        stiffness = Stiffness(weights, factors, (basis.knots_s, basis.knots_r), basis.low, basis.high)
        problem = dataclasses.replace(problem, stiffness=stiffness).with_weights(ones)
        before, solution = solution, gone_on(JACOBIANS)
        if solution.chi2 - count > (1 - GAINS) * max(first.chi2 - count, 0.0):
            return begun, dataclasses.replace(first, interrupted=first.interrupted or solution.interrupted)
        if solution.interrupted or abs(solution.chi2 - before.chi2) < SETTLED * before.chi2:
            break
    return problem, solution if solution.converged or solution.interrupted else gone_on(AT_LAST)
