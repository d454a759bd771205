"""The joint fit: all recordings at once, every free parameter, to the noise.

Harmonics in, the steps of a bounded Levenberg-Marquardt solver behind optimistix's interface, roughness weights by
evidence (MacKay) between them, the residual on a finer grid than the Jacobian, by whose grid trial steps go.
"""

import dataclasses
import functools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.csgraph import structural_rank

from magjax.programs import kept

from .density import DensityBasis, Stiffness
from .model import Layout, Predictor, Target, whitened
from .passes import Passes
from .solver import SteppedLevenbergMarquardt, cost_of
from .together import together

WEIGHT_RANGE = (1e-3, 1e9)
LET_GO, HELD = 30, 0.8  # by what weights fall that hold a fit far above the noise, while chi2 falls to this share of it
STIFF = 1.0  # weights that may hold a fit off its target, or still
FAR = 20.0  # chi2/N above which the weights stay, and an iteration that no longer falls is given up:
STALLED, STALL = 6, 1e-3  # Jacobians, and the share of chi2 that they must take
AT_END = (
    4,
    1.0,
    5e-4,
)  # Jacobians, the fall of half chi2 that they must bring (or this share of it), else nothing more is to be had
PACE = 3, 6  # Jacobians over which the pace towards a target is taken, and after which
MOVED = 4.0  # of chi2, by which the squared change of a misfit since it was last taken on the fine grid asks for that again
UNLIKE = 2e-3, 1e-2  # share of half chi2, by which the fine grid may have it otherwise where a fit ends; of one far from the noise
PROMISED = 1e-2  # share of half chi2 that may still be promised there: a kink, or the coarse Jacobian, keeps it


@dataclasses.dataclass(frozen=True)
class Problem:
    """Everything that stays while one model is fitted: layout, template, predictors (coarse, fine), target."""

    layout: Layout
    template: object
    predictors: tuple[Predictor, Predictor]
    target: Target
    spectra: tuple
    basis: DensityBasis
    quasistatic: bool = False  # the time axis is made up: nothing that depends on a rate may be claimed
    stiffness: Stiffness | None = None  # of each difference by itself, where the density has steps

    @property
    def noise_rms(self) -> float:
        """Typical noise of the reading, rms, its unit."""
        return float(np.median([s.noise_rms for s in self.spectra]))

    @property
    def data_count(self) -> int:
        """Real numbers that the fit must meet."""
        finite = np.isfinite(np.asarray(self.target.deviations))
        return int(2 * finite.sum() - finite[:, 0].sum())

    @functools.cached_property
    def penalties(self) -> tuple:
        """Roughness of the density: a sparse matrix of second differences a family, each row weighed where they have steps."""
        return self.basis.penalties if self.stiffness is None else self.stiffness.of(self.basis.penalties)

    @functools.cached_property
    def passes(self) -> Passes:
        """Its residual and Jacobian."""
        return Passes(self)

    def with_weights(self, weights) -> "Problem":
        """The same problem with other roughness weights."""
        target = eqx.tree_at(lambda t: t.weights, self.target, jnp.asarray(weights, dtype=float))
        return dataclasses.replace(self, target=target)


@dataclasses.dataclass(frozen=True)
class Solution:
    """Where the iteration ended. `chi2`: of the data alone; `decrement`: what one more step promises; `normal` and `gradient`:
    of half of chi2 and of what the prior adds."""

    z: np.ndarray
    weights: np.ndarray
    chi2: float
    cost: float
    decrement: float
    normal: np.ndarray
    gradient: np.ndarray
    jacobians: int
    converged: bool
    seconds: float
    interrupted: bool = False


def data_residual(problem: Problem, z, stride: int = 1):
    """Whitened misfit of the harmonics on the fine grid; marched by every `stride`-th sample of it, see `Passes.residual`."""
    return problem.passes.residual(z, stride)


def fields(problem: Problem, z) -> list:
    """Drive, field H and magnetization M of every recording over a period of the fine grid, as fitted: [(drive, H, M)], (samples,)."""
    return problem.passes.fields(z)


def data_jacobian(problem: Problem, z):
    """Its Jacobian, (data, unknowns), on the coarse grid."""
    return problem.passes.jacobian(z)


def compiled(problem: Problem, z) -> None:
    """Compile what a fit from z needs, side by side."""
    together(problem.passes.compiling(z))


class Corrected:
    """A problem's misfit while it is solved: trial steps march the Jacobian's grid, and are told what the fine one had found beside it
    where both were last taken: where the fit began or ended, and wherever it has moved by more than what is left.

    Of a trial the march on the fine grid took most of the time, and by how much the two differ hardly depends on the unknowns.
    """

    def __init__(self, problem):
        self.problem, self.stride = problem, problem.passes.stride
        self.beyond, self.stale, self.seen, self.known = 0.0, False, None, (None, None)

    def near(self, z) -> np.ndarray:
        """The misfit as a trial step is told."""
        return data_residual(self.problem, z, self.stride) + self.beyond

    def exact(self, z, near=None) -> np.ndarray:
        """The misfit on the fine grid, by which those nearby are corrected; `near`: as they had it there."""
        found = data_residual(self.problem, z)
        if self.stride > 1:
            self.beyond = self.beyond + found - (self.near(z) if near is None else near)
        self.stale, self.seen = False, found
        return found

    def jacobian(self, z) -> np.ndarray:
        """Its derivative, that of the last step at hand."""
        if self.known[0] is not z:
            self.known = z, data_jacobian(self.problem, z)
        return self.known[1]

    def stepped(self, solver, z, posed, state):
        """A step of a solver from z: (unknowns, state). Where the fine grid is asked, it falls there, too."""
        new, then, _ = solver.step(lambda y, _: (self.near(y), None), z, None, posed, state, frozenset())
        if self.stride == 1 or not (then.good or then.decrement > 1.0 + PROMISED * then.cost):
            return new, then
        self.stale = self.stale or then.good
        if then.good:
            if not np.sum((then.residual - self.seen) ** 2) > MOVED * then.chi2:
                return new, then
            right = self._right(new, then, posed, z)
            if right.cost < state.cost:
                return new, dataclasses.replace(right, gained=state.cost - right.cost)
        residual = self.exact(z)  # once more, by the fine grid alone
        state = dataclasses.replace(state, residual=residual, cost=cost_of(residual, z, posed["prior"]))
        return solver.step(lambda y, _: (data_residual(self.problem, y), None), z, None, posed, state, frozenset())[:2]

    def ended(self, z, state, posed):
        """The state where a fit ends, as the fine grid has it."""
        return self._right(z, state, posed, self.known[0]) if self.stale else state

    def _right(self, z, state, posed, begun):
        """A state after a step from `begun` to z, as the fine grid has it."""
        residual = self.exact(z, state.residual)
        gradient = state.gradient + self.jacobian(begun).T @ (residual - state.residual)
        return dataclasses.replace(state, residual=residual, cost=cost_of(residual, z, posed["prior"]), gradient=gradient)


@kept
def _read_residuals(layout, z, lines, target, template, predictor):
    actuators, levels = jax.vmap(lambda y: (layout.actuator(template, y), layout.levels(y)))(z)
    found = predictor.lines_of_each(actuators, levels)
    return jax.vmap(lambda own, measured: whitened(own, eqx.tree_at(lambda t: t.lines, target, measured)))(found, lines)


def data_residuals(problem: Problem, z, lines):
    """`data_residual` of several problems that differ in their measured lines alone, each at its own unknowns:
    (problems, data) for (problems, unknowns) and (problems, recordings, harmonics + 1)."""
    arguments = (problem.layout, jnp.asarray(z), jnp.asarray(lines), problem.target, problem.template, problem.predictors[1])
    return np.asarray(_read_residuals(*arguments))


def evidence_weights(layout: Layout, penalties, z, normal, weights):
    """One MacKay update of each roughness weight: effective number of unknowns over roughness."""
    n = layout.density_unknowns
    z = np.asarray(z)
    active = layout.inside(z)
    # unknowns at their bound carry no freedom: the inverse on the free set only
    inside = np.flatnonzero(active)
    S = np.zeros_like(normal)
    free = normal[np.ix_(inside, inside)]
    S[np.ix_(inside, inside)] = np.linalg.inv(free + 1e-12 * np.diag(np.diag(free)))
    new = []
    for weight, D in zip(weights, penalties, strict=True):
        roughness = float(np.sum((D @ z[:n]) ** 2))
        D = D[:, active[:n]]
        taken = weight * D.multiply(D @ S[:n, :n][np.ix_(active[:n], active[:n])]).sum()
        gamma = max(structural_rank(D) - taken, 0.5)
        new.append(np.clip(gamma / max(roughness, 1e-12), *WEIGHT_RANGE))
    return np.asarray(new)


def prior_matrix(problem: Problem, weights) -> np.ndarray:
    """Curvature of half the prior's sum of squares: roughness penalties and stated priors, (unknowns, unknowns)."""
    layout = problem.layout
    n = layout.density_unknowns
    matrix = np.zeros((layout.size, layout.size))
    for weight, D in zip(weights, problem.penalties, strict=True):
        matrix[:n, :n] += (weight * (D.T @ D)).toarray()
    matrix[n, n] += float(problem.target.bottom_prior) ** 2
    matrix[n + 1 :, n + 1 :] += np.diag(np.asarray(problem.target.priors) ** 2)
    return matrix


def _too_slow(path, left: int, target: float) -> bool:
    """Whether a chi2 that falls by as much a Jacobian as of late does not come to the target in those that are left."""
    return len(path) > PACE[1] and path[-1] - left * (path[-1 - PACE[0]] - path[-1]) / PACE[0] > target


def solve(
    problem: Problem, z, weights, *, max_jacobians: int = 30, evidence: bool = True, progress=None, target: float = np.inf
) -> Solution:
    """Minimise from z, one Jacobian and a few trial dampings a step.

    An optimistix solver whose steps are asked for one by one, for the roughness weights move between them.
    `progress(step, chi2 per datum)` is called after each Jacobian; Ctrl-C keeps what was reached. `target`: a chi2 that must
    be reached to be of use; once four times the promised fall cannot lead there, or the pace, the iteration ends.
    """
    layout, count = problem.layout, problem.data_count
    evidence = evidence and problem.stiffness is None
    solver, told = SteppedLevenbergMarquardt(layout.bounds), Corrected(problem)
    z, weights = np.asarray(z, float), np.asarray(weights, float)
    posed = {"jacobian": told.jacobian, "prior": prior_matrix(problem, weights)}

    def residual_at(z, _):
        return told.near(z), None

    def weighed(z, state, new):
        """The state under other roughness weights."""
        posed["prior"] = prior_matrix(problem, new)
        return dataclasses.replace(state, cost=cost_of(state.residual, z, posed["prior"]))

    def eased(chi2):
        """Where it stands, lower weights, the state under them, and a path and gains that begin anew."""
        lower = np.maximum(weights / LET_GO, WEIGHT_RANGE[0])
        return chi2, lower, weighed(z, state, lower), [chi2], []

    begin, converged, interrupted, taken, held = time.perf_counter(), False, False, 0, np.inf
    told.exact(z)
    state = solver.init(residual_at, z, None, posed, None, None, frozenset())
    path, gains = [state.chi2], []
    try:
        for taken in range(1, max_jacobians + 1):
            z, state = told.stepped(solver, z, posed, state)
            gains.append(state.gained)
            chi2 = state.chi2
            if progress is not None:
                progress(taken, chi2 / count)
            path.append(chi2)
            if not (state.good or np.isfinite(state.decrement)):  # it began beyond all reason
                break
            far = chi2 / count > FAR
            missed = taken > 3 and chi2 - 8 * state.decrement > target or _too_slow(path, max_jacobians - taken, target)
            stuck = far and len(path) > STALLED and chi2 > (1 - STALL) * path[-STALLED]
            if missed or stuck:
                if not (far and evidence and weights.max() > STIFF and chi2 < HELD * held):
                    break
                held, weights, state, path, gains = eased(chi2)  # a rough density, held by what was meant for a smooth one
                continue
            stalled = len(gains) >= AT_END[0] and sum(gains[-AT_END[0] :]) < max(AT_END[1], AT_END[2] * state.cost)
            settled = stalled or bool(solver.terminate(residual_at, z, None, posed, state, frozenset())[0])
            if evidence and chi2 / count < FAR:
                found = evidence_weights(layout, problem.penalties, z, state.information + posed["prior"], weights)
                moved = np.max(np.abs(np.log(found / weights)), initial=0.0)
                weights = weights * np.clip(found / weights, 1 / 30, 30)
                state = weighed(z, state, weights)
                settled = stalled or settled and moved < 0.3
            elif evidence and settled:
                # settled far above the noise: as long as the prior, not the physics, holds it there, let go
                if chi2 < HELD * held and weights.max() > 10 * WEIGHT_RANGE[0]:
                    held, weights, state, path, gains = eased(chi2)
                    settled = False
            if settled or not state.good:
                converged = state.decrement < 1.0 + (PROMISED if stalled else 1e-3) * state.cost
                if settled or not evidence or state.decrement < 1.0:
                    near, state = state, told.ended(z, state, posed)
                    if abs(state.cost - near.cost) < max(AT_END[1], UNLIKE[far] * near.cost):
                        break
                    gains = []  # on the fine grid it has not ended
                state = dataclasses.replace(state, damping=min(state.damping, 1e2))
    except KeyboardInterrupt:
        converged, interrupted = False, True
    state = told.ended(z, state, posed)
    # under the weights that are returned: they may have moved after the last step
    normal = state.information + posed["prior"]
    seconds = time.perf_counter() - begin
    return Solution(
        z, weights, state.chi2, state.cost, state.decrement, normal, state.gradient, taken, converged, seconds, interrupted
    )
