"""How well a fit foretells recordings that took no part in it, held against what it knows: its predictive density.

A fit knows its parameters and its density within errors; carried to another drive these are what it expects to miss, beside
the noise: little where its own recordings have told of the same cells, far more where only the smoothness of the density does.
Errors that are held against the noise alone blame a model for cells that nobody switched; the logarithm of the predictive
density (of the readings of the check recordings, the recordings of the fit given) does not. Twice the difference of two
models' is what the check recordings say for the one against the other, as a difference of chi2 does for those of the fit.
"""

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from magjax.extrema import nesting
from magjax.recording import follows_nothing

from .check import beyond_plane
from .joint import data_jacobian, data_residual
from .model import Predictor
from .reach import BEYOND
from .setup import period_samples, spectra_of
from .spectra import line_deviations
from .uncertainty import covariance

PHASES = np.arange(400) / 400


@dataclasses.dataclass(frozen=True)
class Foretold:
    """`log_density`: of all check recordings together, up to a constant that is the same for all fits; `whitened`: their chi2 per
    number in units of what is expected (1 where the fit is right about what it knows); `expected_rms`: of each recording's
    error, noise included, its unit."""

    log_density: float
    whitened: float
    expected_rms: tuple[float | None, ...]


class Foreteller:
    """What fits of one task say of its check recordings: of those that are periodic and within the plane of a fit, `base`."""

    def __init__(self, recordings, base):
        self.recordings, self.base, self.known = tuple(recordings), base, {}

    @functools.cached_property
    def places(self) -> tuple[int, ...]:
        """Of the recordings that it goes by."""
        actuator, bench = self.base.actuator, self.base.bench
        periodic = [k for k, r in enumerate(self.recordings) if r.frequency() is not None and not follows_nothing(r, bench.output)]
        return tuple(k for k in periodic if not beyond_plane(actuator, self.recordings[k], bench) > BEYOND)

    @functools.cached_property
    def spectra(self) -> tuple:
        """Of these."""
        some = [self.recordings[k] for k in self.places]
        return tuple(spectra_of(some, self.base.bench, self.base.choices.harmonics)) if some else ()

    def __bool__(self):
        return bool(self.recordings)

    def __call__(self, result) -> Foretold | None:
        """As `foretold`; None where no recording serves."""
        if not self.spectra:
            return None
        if id(result) not in self.known:
            self.known[id(result)] = result, foretold(result, self.spectra)
        return self.known[id(result)][1]

    def says_for(self, after, before) -> float | None:
        """Twice the logarithm of the predictive densities' ratio, for `after` against `before`: as a fall of chi2; None where no
        recording serves. Where even the better of them expects too little of itself, in units of what it misses."""
        new, old = self(after), self(before)
        if new is None:
            return None
        if not (np.isfinite(new.log_density) and np.isfinite(old.log_density)):  # a simulation that fails foretells nothing
            return float(np.isfinite(new.log_density)) - float(np.isfinite(old.log_density))
        return 2 * (new.log_density - old.log_density) / max(min(new.whitened, old.whitened), 1.0)

    def beside(self, rows, result) -> list[dict]:
        """Rows of `check_errors` with `expected_rms`: what the fit expects its error to be, noise included; None where a recording
        does not serve."""
        found = self(result)
        known = dict(zip(self.places, found.expected_rms if found else (), strict=True))
        return [{**row, "expected_rms": known.get(k)} for k, row in enumerate(rows)]


def foretold(result, spectra) -> Foretold:
    """What a fit says of periodic recordings that took no part in it. `spectra`: theirs, of the same channels.

    What is not linear in the unknowns is left out.
    """
    problem, z = result.problem, result.solution.z
    layout = problem.layout
    memories = layout.memories
    most = memories or len(spectra)  # each has a level of M of its own, as those of the fit
    parts = [_whitened(result, spectra[at : at + most]) for at in range(0, len(spectra), most)]
    residual, slope = (np.concatenate(part) for part in zip(*parts, strict=True))
    shared = len(z) - memories
    known = _known(result.solution, layout)[:shared, :shared]
    spread = slope[:, :shared] @ known @ slope[:, :shared].T
    lines = len(residual) // len(spectra)
    for k in range(len(spectra) if memories else 0):  # the level of M of each is its own
        rows = slice(k * lines, (k + 1) * lines)
        level = slope[rows, shared:].sum(axis=1)
        spread[rows, rows] += np.outer(level, level)
    real = slope.any(axis=1) | (residual != 0)
    total = np.eye(len(residual)) + spread
    if not np.all(np.isfinite(total)) or not np.all(np.isfinite(residual)):
        return Foretold(-np.inf, np.inf, (None,) * len(spectra))
    root = np.linalg.cholesky(total)
    white = np.linalg.solve(root, residual)
    log_density = -0.5 * white @ white - np.log(np.diag(root)).sum()
    expected = []
    for k, s in enumerate(spectra):
        deviations = _deviations(problem, s)
        finite = np.where(np.isfinite(deviations), deviations, 0.0)
        finite[0] *= not s.zero  # what has a zero of its own is held against the prediction's mean
        weights = np.concatenate([finite**2 * np.where(np.arange(len(finite)) > 0, 2.0, 1.0), 2 * finite[1:] ** 2])
        unknown = float(weights @ np.diag(spread)[k * lines : (k + 1) * lines])
        expected.append(float(np.sqrt(unknown + s.noise_rms**2)))
    return Foretold(float(log_density), float(white @ white / max(real.sum(), 1)), tuple(expected))


def _known(solution, layout):
    """Covariance of the unknowns. One that stands at the floor of the density is not known to be there: the likelihood falls from
    there as an exponential of its gradient, whose variance is 1 / gradient^2, or as a normal law where that is narrower."""
    normal, n = np.array(solution.normal), layout.density_unknowns
    floored = np.flatnonzero(~layout.inside(solution.z)[:n])
    normal[floored, floored] += solution.gradient[floored] ** 2
    return covariance(normal, solution.z, layout, range(n))


def _deviations(problem, spectrum):
    """Of the lines that the problem predicts; infinite where the recording has none."""
    found = np.full(problem.predictors[0].harmonics + 1, np.inf)
    own = line_deviations(spectrum, spectrum.noise)[: len(found)]
    found[: len(own)] = own
    if np.isinf(np.asarray(problem.target.deviations)[:, 0]).all():  # an integrated emf has no mean
        found[0] = np.inf
    return found


def _whitened(result, spectra):
    """Misfit of the spectra in units of their noise, recording by recording, and its slopes."""
    problem, predictor = result.problem, result.problem.predictors[0]
    corners = max(predictor.corners, 4 * int(np.ceil(max(nesting(np.tile(s.drive_at(PHASES), 2)) for s in spectra) / 4)))
    grids = tuple(
        Predictor.build(spectra, samples, predictor.harmonics, max(predictor.periods), corners, apart=False)
        for samples in period_samples(result.choices, result.bench)
    )
    width = predictor.harmonics + 1
    lines = np.zeros((len(spectra), width), complex)
    for row, s in zip(lines, spectra, strict=True):
        row[: len(s.reading)] = s.reading[:width]
    target = problem.target
    zeros = jnp.zeros(lines.shape, complex), jnp.zeros((len(spectra),) * 2)
    values = jnp.asarray(lines), jnp.asarray(np.stack([_deviations(problem, s) for s in spectra])), *zeros
    target = eqx.tree_at(lambda t: (t.lines, t.deviations, t.gain_rows, t.gain_shares), target, values)
    z = np.array(result.solution.z)
    z[len(z) - problem.layout.memories :] = 0.0
    theirs = dataclasses.replace(problem, predictors=grids, target=target, spectra=tuple(spectra))
    places = np.concatenate([np.repeat(np.arange(len(spectra)), width), np.repeat(np.arange(len(spectra)), width - 1)])
    order = np.argsort(places, kind="stable")
    return data_residual(theirs, z)[order], data_jacobian(theirs, z)[order]
