"""The joint fit: all recordings at once, every free parameter, to the noise.

Harmonics in, projected Levenberg-Marquardt through optimistix's step interface, roughness weights by evidence
(MacKay) while it runs, the residual on a finer grid than the Jacobian.
"""

import dataclasses
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .model import Layout, Predictor, Target, prior_rows, whitened
from .solver import ProjectedLevenbergMarquardt, jacobian

WEIGHT_RANGE = (1e-3, 1e9)


@dataclasses.dataclass(frozen=True)
class Problem:
    """Everything that stays while one model is fitted: layout, template, predictors (coarse, fine), target."""

    layout: Layout
    template: object
    predictors: tuple[Predictor, Predictor]
    target: Target
    spectra: tuple
    noise: object

    @property
    def data_count(self) -> int:
        """Real numbers that the fit must meet."""
        finite = np.isfinite(np.asarray(self.target.deviations))
        return int(2 * finite.sum() - finite[:, 0].sum())

    def with_weights(self, weights) -> "Problem":
        """The same problem with other roughness weights."""
        target = eqx.tree_at(lambda t: t.weights, self.target, jnp.asarray(weights, dtype=float))
        return dataclasses.replace(self, target=target)


@dataclasses.dataclass(frozen=True)
class Solution:
    """Where the iteration ended. `chi2`: of the data alone; `decrement`: what one more step promises."""

    z: np.ndarray
    weights: np.ndarray
    chi2: float
    cost: float
    decrement: float
    normal: np.ndarray
    jacobians: int
    converged: bool
    seconds: float


def _residual(which: int):
    def fn(z, args):
        layout, target, template, predictors = args
        lines = predictors[which](layout.actuator(template, z))
        return jnp.concatenate([whitened(lines, target), prior_rows(layout, z, target)]), None

    return fn


@eqx.filter_jit
def _step(layout, z, state, target, template, predictors):
    solver = ProjectedLevenbergMarquardt(jnp.asarray(layout.nonnegative))
    args = (layout, target, template, predictors)
    z, state, _ = solver.step(_residual(1), z, args, {"jacobian_fn": _residual(0)}, state, frozenset())
    return z, state


@eqx.filter_jit
def _data_residual(layout, z, target, template, predictors):
    return whitened(predictors[1](layout.actuator(template, z)), target)


@eqx.filter_jit
def _data_jacobian(layout, z, target, template, predictors):
    return jacobian(lambda y: whitened(predictors[0](layout.actuator(template, y)), target), z)


def data_residual(problem: Problem, z):
    """Whitened misfit of the harmonics on the fine grid."""
    return np.asarray(_data_residual(problem.layout, jnp.asarray(z), problem.target, problem.template, problem.predictors))


def data_jacobian(problem: Problem, z):
    """Its Jacobian, (data, unknowns), on the coarse grid."""
    return np.asarray(_data_jacobian(problem.layout, jnp.asarray(z), problem.target, problem.template, problem.predictors))


def evidence_weights(layout: Layout, z, normal, weights, misfit: float):
    """One MacKay update of each roughness weight: effective number of unknowns over roughness, times the misfit."""
    n = layout.density_unknowns
    z = np.asarray(z)
    S = np.linalg.inv(normal + 1e-10 * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(normal)))
    active = np.append(z[:n] > 0, np.ones(len(z) - n, bool))
    # unknowns at their bound carry no freedom: the inverse on the free set only
    inside = np.flatnonzero(active)
    S = np.zeros_like(normal)
    free = normal[np.ix_(inside, inside)]
    S[np.ix_(inside, inside)] = np.linalg.inv(free + 1e-12 * np.diag(np.diag(free)))
    new = []
    for weight, D in zip(weights, layout.penalties, strict=True):
        D = np.asarray(D)
        roughness = float(np.sum((D @ z[:n]) ** 2))
        D = D[:, active[:n]]
        rank = np.linalg.matrix_rank(D)
        taken = weight * np.einsum("ij,jk,ik->", D, S[:n, :n][np.ix_(active[:n], active[:n])], D)
        gamma = max(rank - taken, 0.5)
        new.append(np.clip(misfit * gamma / max(roughness, 1e-12), *WEIGHT_RANGE))
    return np.asarray(new)


def solve(problem: Problem, z, weights, *, max_jacobians: int = 30, evidence: bool = True, progress=None) -> Solution:
    """Minimise from z. `progress(step, chi2 per datum)` is called after each Jacobian; Ctrl-C keeps what was reached."""
    layout, count = problem.layout, problem.data_count
    z, weights = jnp.asarray(z), np.asarray(weights, float)
    solver = ProjectedLevenbergMarquardt(jnp.asarray(layout.nonnegative))
    state = solver.init(None, z, None, {}, None, None, None)
    begin, converged, taken, chi2 = time.perf_counter(), False, 0, np.inf
    try:
        for taken in range(1, max_jacobians + 1):
            current = problem.with_weights(weights)
            z, state = _step(layout, z, state, current.target, problem.template, problem.predictors)
            prior = 0.5 * float(jnp.sum(prior_rows(layout, z, current.target) ** 2))
            chi2 = 2 * (float(state.cost) - prior)
            if progress is not None:
                progress(taken, chi2 / count)
            settled = float(state.decrement) < 0.5 + 1e-4 * float(state.cost)
            if evidence and chi2 / count < 20:
                misfit = 1.0
                new = evidence_weights(layout, z, np.asarray(state.normal), weights, misfit)
                moved = np.max(np.abs(np.log(new / weights)))
                weights = weights * np.clip(new / weights, 1 / 30, 30)
                settled = settled and moved < 0.3
            if settled or (bool(state.done) and not evidence):
                converged = bool(float(state.decrement) < 1.0 + 1e-3 * float(state.cost))
                break
    except KeyboardInterrupt:
        converged = False
    return Solution(
        np.asarray(z), weights, chi2, float(state.cost), float(state.decrement), np.asarray(state.normal), taken, converged,
        time.perf_counter() - begin,
    )  # fmt: skip
