"""Screening: what each effect of the catalogue would do to the misfit, to first order, beside everything the base can do.

For a candidate with amplitude a the column is c = d(whitened misfit)/da at null. Projected off the tangent space of the
base fit (all density unknowns with a tenth of their roughness weights, all free parameters), z = c_perp . r / |c_perp|
is the score in standard deviations, z^2 the predicted fall of chi2, and |c_perp|/|c| the visibility. Shape parameters,
which mean nothing at null, are scanned over a log grid. Record-level effects (drift, heat, hum) are scored in the time
domain between the harmonics.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from magjax.constants import MU0
from magjax.effects import CATALOGUE

from .adjoint import as_lines
from .columns import bare, drive_change, in_step_change, last_period, late_change, lines_of, marching, signals_of
from .joint import data_jacobian, data_residual
from .spectra import reading_range
from .together import let_go
from .uncertainty import UNDERSMOOTH

SHAPE_GRIDS = {
    "amplifier_lag": {"order2": (0.25,)},
    "excess_loss": {"rate_knee": (0.3, 10.0, 100.0)},
    "second_eddy_path": {"tau": (1e-4, 5e-4, 2e-3, 8e-3), "air": (0.05, 0.9)},
    "stress_feedback": {"inertia": (0.0, 5.0)},
    "accommodation": {"pace": (0.0, 0.5)},  # a quick one scores as a mean field does, and leads there
    "magnetic_aftereffect": {"of_field": (0.05, 0.9)},
    "rate_dependent_switching": {"rate0": (1e3, 3e4, 1e6), "of_flux": (0.05, 0.9), "of_drive": (0.0, 0.9)},
    "second_mode": {"f2": tuple(150.0 * 1.09**k for k in range(36)), "xi2": (0.02, 0.1)},  # a mode is narrow
    "structural_damping": {"dispersion": (0.0, 1.0), "mean_below": (0.0, 4.0)},
    "strain_hysteresis": {"width": (0.03, 0.1), "of_m": (0.05, 0.9), "smooth": (0.5,)},
    "duffing_stiffness": {"rest": (0.0, 0.35)},  # a spring under preload is at rest within the stroke
    "delta_e": {"static": (0.05, 0.9)},
    "creep": {"shortest": (1e-4, 1e-2), "mean_behind": (0.0, 4.0)},
    "coulomb_friction": {"v_s": (1e-5, 1e-3), "presliding": (1e-8, 1e-7, 1e-6)},
    "sensor_lag": {"order2": (0.0, 0.5)},
    "sensor_nonlinearity": {"mix": (-0.25 * np.pi, 0.0, 0.25 * np.pi, 0.5 * np.pi), "c0": (-3.0, 0.0, 3.0)},
}


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One effect's score. `amplitude`: first-order estimate in its unit; `shapes`: best of the grid;
    `smallest_visible`: amplitude seen at five standard deviations; `tried_at`: the finite amplitude that was scored, where it
    was (what is visible is then not known, and both others are that); `direction`: projected unit column."""

    name: str
    block: str
    z: float
    visibility: float
    amplitude: float
    shapes: dict
    predicted_chi2_drop: float
    smallest_visible: float
    one_sided: bool
    direction: np.ndarray = dataclasses.field(repr=False, default=None)
    tried_at: float | None = None
    achieved_chi2_drop: float | None = None
    bic_change: float | None = None


def shape_grid(effect_class, readings=(0.0, 0.0)):
    """All combinations of shape parameters to try, with what is given by the lowest and the highest reading: list of dicts."""
    grid = [effect_class.seen_in(readings)]
    for name, values in SHAPE_GRIDS.get(effect_class.name, {}).items():
        grid = [{**g, name: v} for g in grid for v in values]
    return grid


RATE_FREE = (
    "mean_field",
    "reversible_magnetization",
    "accommodation",
    "quartic_magnetostriction",
    "linear_strain",
    "strain_hysteresis",
    "sensor_nonlinearity",
)


def applicable(actuator, quasistatic: bool = False):
    """Effects of the catalogue that serve this actuator, whose block it has, and that it does not hold already.

    `quasistatic`: without a time axis only rate-independent effects can be asked for.
    """
    held = {e.name for e in actuator.effects}
    found = []
    for effect in CATALOGUE:
        if effect.name in held or (quasistatic and effect.name not in RATE_FREE):
            continue
        if not effect.serves(actuator):
            continue
        if effect.block in ("magnetostriction", "mechanics") and getattr(actuator, effect.block) is None:
            continue
        if effect.name == "stress_feedback" and actuator.mechanics is None:
            continue
        lossy = float(np.asarray(actuator.coil.loss)) > 0
        if effect.name == "eddy_currents" and lossy:  # the base has them: R_eddy or k_eddy
            continue
        if effect.name in ("field_diffusion", "second_eddy_path") and not lossy:  # they scale with what is not there
            continue
        if actuator.output != "displacement" and effect.name == "linear_strain":
            continue
        found.append(effect)
    return found


def _behind(classes, predictor, actuator, signals, readings):
    """(class, shapes) of all that act behind the hysteresis, and what they do there: (free displacement, displacement, reading)."""
    asked, rows = [], []
    for c in classes:
        if not c.in_step and c.block != "source":
            shapes = shape_grid(c, readings)
            stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *(c(**s) for s in shapes))
            asked += [(c, s) for s in shapes]
            rows += late_change(stacked, predictor.behind(), actuator, signals)
    return asked, [np.concatenate(x) for x in zip(*rows, strict=True)]


def _before(classes, trials, predictor, own, path, rows):
    """(class, shapes) of all that act before the magnetostriction, and the change of the lines, (columns, recordings, lines).

    `trials`: finite amplitudes of the classes that have no derivative at null; `own`: the actuator with the effects that march;
    `path`: of its march; `rows`: what lines ask."""
    plain, number, found = bare(own), len(rows.mean), {}
    for c in classes:
        if c.shells or not (c.in_step or c.block == "source"):
            continue
        for shapes in trials[c] or shape_grid(c):
            if c.in_step:
                change = in_step_change(c(**shapes), predictor, plain, path, c.amplitude in shapes)
                found.setdefault(True, []).append(((c, shapes), [np.asarray(x)[:number] for x in change]))
            else:
                (change,) = drive_change(c(**shapes), predictor.behind(), plain)
                found.setdefault(False, []).append(((c, shapes), np.asarray(change)[:number]))
    lines = [rows.of_steps(*(np.stack(x) for x in zip(*(change for _, change in found[True]), strict=True)))] if True in found else []
    lines += [rows.of_drive(np.stack([change for _, change in found[False]]))] if False in found else []
    return [asked for kind in (True, False) for asked, _ in found.get(kind, ())], lines


def _changes(classes, trials, predictor, actuator, rows, readings, levels):
    """(class, shapes) of every effect, and the first-order change of the lines of the predictor's recordings, (columns, recordings,
    harmonics + 1)."""
    own, number, filled = marching(actuator), len(rows.mean), predictor.filled
    fields = [[filled(x) for x in (rows.marched.field, rows.marched.magnetization, rows.marched.spread)]]
    path = (*(filled(x) for x in rows.path()), predictor.steps[0])
    times = np.asarray(predictor.periods[0])
    predictor = dataclasses.replace(predictor, periods=((path[0].shape[1] - 1) // rows.signals.shape[3],))  # those that the path has
    signals = signals_of(predictor.behind(), actuator, fields)
    behind, late = _behind(classes, predictor, bare(actuator), signals, readings)
    before, lines = _before(classes, trials, predictor, own, path, rows)
    asked = before + behind
    if behind:
        lines.append(rows.of_signals(*(np.asarray(x)[:, :number] for x in late)))
    lines = [as_lines(x) for x in lines]
    for c in classes:
        for shapes in trials[c] if c.shells else ():
            other = last_period(predictor.behind(predictor.corners), own.with_effect(c(**shapes)), filled(levels), times)
            change = lines_of(predictor, signals_of(predictor.behind(), actuator, [other])) - lines_of(predictor, signals)
            lines.append(change[None, :number])
            asked.append((c, shapes))
    return asked, np.concatenate(lines)


def columns(problem, z):
    """First-order change of the whitened misfit by every applicable effect: list of (class, shapes, column)."""
    actuator = problem.layout.actuator(problem.template, np.asarray(z))
    predictor = problem.predictors[0]
    classes = [c for c in applicable(actuator, problem.quasistatic) if not c.record_level]
    drives, H, M = zip(*problem.passes.fields(z), strict=True)
    fluxes = [MU0 * (h + m) for h, m in zip(H, M, strict=True)]
    steps = [1 / (s.frequency * len(drive)) for s, drive in zip(problem.spectra, drives, strict=True)]
    trials, lines = {c: c.finite_trials(drives, fluxes, steps) for c in classes}, []
    levels = problem.layout.levels(np.asarray(z))
    levels = np.zeros(len(problem.spectra)) if levels is None else np.asarray(levels)
    for part, places, rows in problem.passes.rows(z):
        asked, found = _changes(classes, trials, part, actuator, rows, reading_range(problem.spectra), levels[places])
        lines.append(found)
    lines = np.concatenate(lines, axis=1)[:, np.asarray(predictor.index)]
    return [(c, s, column) for (c, s), column in zip(asked, problem.passes.change(lines), strict=True)]


class Projector:
    """Projects columns off the tangent space of a fit, prior rows included."""

    def __init__(self, problem, solution):
        layout = problem.layout
        n = layout.density_unknowns
        z = solution.z
        J = data_jacobian(problem, z)
        free = np.append(z[:n] > 0, np.ones(len(z) - n, bool))
        rows, leftover = [], []
        for w, D in zip(UNDERSMOOTH * solution.weights, problem.penalties, strict=True):
            rows.append(np.sqrt(w) * D.toarray())
            leftover.append(rows[-1] @ z[:n])
        prior = np.zeros((sum(len(r) for r in rows) + len(z) - n - 1, len(z)))
        at = 0
        for r in rows:
            prior[at : at + len(r), :n] = r
            at += len(r)
        prior[at:, n + 1 :] = np.diag(np.asarray(problem.target.priors))
        whole = np.concatenate([J, prior])[:, free]
        scale = np.linalg.norm(whole, axis=0)
        whole = whole[:, scale > 0] / scale[scale > 0]
        self.basis, _ = np.linalg.qr(whole)
        self.count = len(J)
        r = np.concatenate([data_residual(problem, z), *leftover, np.asarray(problem.target.priors) * z[n + 1 :]])
        self.residual = r - self.basis @ (self.basis.T @ r)
        self.raw = r

    def project(self, column):
        """The part of a data column that the base cannot make."""
        whole = np.concatenate([column, np.zeros(len(self.raw) - self.count)])
        for _ in range(2):
            whole = whole - self.basis @ (self.basis.T @ whole)
        return whole


def screen(problem, solution) -> list[Candidate]:
    """Every applicable periodic effect, best first."""
    projector = Projector(problem, solution)
    best: dict[str, Candidate] = {}
    for effect, shapes, column in columns(problem, solution.z):
        size = np.linalg.norm(column)
        if not np.isfinite(size) or size == 0:
            continue
        part = projector.project(column)
        length = np.linalg.norm(part)
        score = -float(part @ projector.residual) / max(length, 1e-300)
        info = effect.parameters()[effect.amplitude]
        one_sided = info.low >= 0
        z = max(score, 0.0) if one_sided else score
        if length / size < 1e-4:
            z = 0.0
        amplitude, visible = score / max(length, 1e-300), float(5 / max(length, 1e-300))
        tried_at = shapes.get(effect.amplitude)
        if tried_at is not None:  # scored at a finite amplitude: start the fit there
            amplitude = visible = tried_at
            shapes = {k: v for k, v in shapes.items() if k != effect.amplitude}
        candidate = Candidate(
            effect.name, effect.block, z, float(length / size), amplitude, shapes, float(z * z), visible, one_sided, part / max(length, 1e-300),
            None if tried_at is None else float(tried_at),
        )  # fmt: skip
        if effect.name not in best or abs(candidate.z) > abs(best[effect.name].z):
            best[effect.name] = candidate
    return sorted(best.values(), key=lambda c: -abs(c.z))


def screened(result, choices) -> list:
    """Every effect that may be asked for, best first."""
    if result.quoted.interrupted:
        raise KeyboardInterrupt
    found = [c for c in screen(result.problem, result.refined) if c.name not in choices.without]
    found = [c for c in found if c.name in choices.only] if choices.only else found
    let_go(result.actuator)  # a program an effect, of a density and of other effects that seldom come again
    return found
