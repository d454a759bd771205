"""fit(recordings, bench): the joint fit as users call it, with its gates and its outcome in words."""

import dataclasses
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from magjax.bench import load_bench
from magjax.plausibility import si_unit
from magjax.recording import stray_samples
from magjax.simulate import require_x64

from .floors import swapped
from .joint import compiled, data_residual, prior_matrix, solve
from .result import FitResult, RecordingFit
from .setup import EDDY_EFFECT, START_WEIGHTS, Choices, build_problem, field_of_rest, free_parameters, spectra_of, with_held_masses
from .together import together
from .uncertainty import UNDERSMOOTH, correlations, covariance, estimates

CELLS = tuple({"knots": None, "cells": cells} for cells in (30, 40))  # a mass a cell: a rough density may need them
FINER = (  # densities tried where the misfit asks for them, those of one step side by side
    ({"knots": (26, 18)},),
    ({"knots": (36, 24)}, *CELLS),
    ({"knots": (48, 32)},),
)
FINER_MATERIAL = (  # where the field is known loops are steep, and cells too wide
    ({"knots": (26, 18), "level": 144},),
    ({"knots": (36, 24), "level": 144},),
    (),
)
FINER_FROM = (1.05, 1.5, 2.0)  # chi2/N from which each step is tried,
FINER_TAKES = (0.7, 0.5, 0.5)  # and the share of the excess that it may leave
CELLS_MEET = 1.25  # chi2/N that cells must reach too: they take up physics, but not all of it
REFINE_BELOW = 8.0  # chi2/N above which it is physics that is missing
REFINE_BESIDE = 30.0  # the same beside an effect: what it leaves may well be the density
CALM = 0.25  # mean square of the recordings' levels in units of their prior, above which another start memory is tried
REST_SETTLED = 1.15  # chi2/N below which no other start memory is tried
ASTRAY = 1e3  # chi2/N from which the signs of M in the loops that a fit began with are in doubt
LOST, AT_BOUND = 1e5, 100.0  # chi2/N from which a fit has led nowhere, and one with a parameter at its bound
SLOW, MOST_STROKE = 0.3, 1.1  # of f0, below which a rod moves as its strain does; of the rod's reach, that noise may add
VALLEY = 0.98  # correlation from which two parameters are one
LEARNED = "effects.learned_term."  # its coefficients are many, and held by their prior on purpose: none is named by itself
REFINE_MATERIAL = 100.0  # instead of 8 where the field is known: steep loops ask for finer hats from far off


def fit(
    recordings,
    bench,
    *,
    actuator=None,
    extra=(),
    choices: Choices = Choices(),
    progress=None,
    refine: bool | float = True,
    start=None,
    target: float = np.inf,
    spectra=None,
) -> FitResult:
    """Fit an actuator to recordings jointly.

    `bench`: a `Bench` or its name; `actuator`: start (the bench's constants if None), effects included; `extra`: names
    of further free parameters; `refine`: let a finer density be chosen where the misfit asks for it, or up to what chi2/N;
    Masses that `bench.free` does not name are held at those of `actuator`, with its start memory.
    `progress`: called as progress(text, step, chi2 per datum); `target`: a chi2 above which the fit is of no use and may end early;
    `spectra`: those of the recordings, where another fit of the same has them; `start`: a fit whose density and weights are
    gone on from.
    Returns a `FitResult`; raises `RecordingError` where a recording cannot be used and `ConfigurationError` for a wrong
    bench. Non-convergence is a result, not an exception.
    """
    require_x64()
    bench = load_bench(bench)
    choices = with_held_masses(choices, bench, actuator)
    actuator = bench.actuator() if actuator is None else actuator
    begin = time.perf_counter()
    spectra = spectra_of(recordings, bench, choices.harmonics) if spectra is None else spectra
    names = free_parameters(bench, actuator, extra)
    history = []

    def report(text, step=0, chi2=None):
        history.append((text, int(step), None if chi2 is None else float(chi2)))
        if progress is not None:
            progress(text, step, chi2)

    start = None if start is not None and _changes_scale(bench, names, start) else start
    problem, z = build_problem(
        spectra, actuator, bench, names, dataclasses.replace(choices, rest=rests_of(bench, choices)[0][0]), _density(start)
    )
    compiled(problem, z)
    warm = time.perf_counter() - begin
    asked = choices
    problem, solution, choices = _start_memories(problem, z, actuator, bench, names, asked, spectra, start, report, target)
    if start is None and solution.chi2 > ASTRAY * problem.data_count and not solution.interrupted:
        found = _with_turning(z, solution, actuator, bench, names, asked, spectra, report, target)
        problem, solution, choices = found or (problem, solution, choices)
    if refine and choices.knots is not None and not solution.interrupted:
        highest = REFINE_MATERIAL if bench.drive != "current" else REFINE_BESIDE if actuator.effects else REFINE_BELOW
        highest = highest if refine is True else refine
        problem, solution, choices = _refine_density(problem, solution, actuator, bench, names, choices, spectra, report, highest)
    ended = finish(problem, solution, choices, bench, recordings, warm, target)
    return dataclasses.replace(ended, history=tuple(history))


def fit_or_stop(*arguments, **options) -> FitResult:
    """`fit` as a step of something longer: Ctrl-C is raised, not answered with what was reached."""
    result = fit(*arguments, **options)
    if result.solution.interrupted:
        raise KeyboardInterrupt
    return result


RESTS = {  # a rod is demagnetized with its bias on, or before that was put on
    "negative_saturation": ("negative",), "demagnetized": ("demagnetized", "virgin"), "positive_saturation": ("positive",),
}  # fmt: skip
RESTS_IN_ORDER = tuple(found[0] for found in RESTS.values())


def rests_of(bench, choices):
    """Start memories to try, in order: those that the bench states, and those that stand in where none of these serves."""
    if choices.rest != "auto":
        return (choices.rest,), ()
    if isinstance(bench.start, tuple):  # a history of fields
        return ("negative",), ()
    if bench.start not in RESTS:
        return RESTS_IN_ORDER, ()
    stated = RESTS[bench.start] if bench.drive == "current" else RESTS[bench.start][:1]  # no bias to put on
    return stated, tuple(rest for rest in RESTS_IN_ORDER if rest not in stated)


def _changes_scale(bench, names, start) -> bool:
    """Whether a first eddy loss is asked for where the field is known: the density learned without it holds its width."""
    return bench.drive == "field" and EDDY_EFFECT in names and EDDY_EFFECT not in start.problem.layout.names


def _density(start):
    """Density unknowns and bottom of a fit, None for None."""
    return None if start is None else start.solution.z[: start.problem.layout.density_unknowns + 1]


def _start_memories(problem, z, actuator, bench, names, choices, spectra, start, report, target):
    """The fit from each start memory until one meets the noise; the best of them. The first by itself, then the others side by side.

    One that the bench does not state is taken only where it meets the noise and none that it states does.
    """
    rests, others = rests_of(bench, choices)

    def run(rest, posed=None):
        tried = dataclasses.replace(choices, rest=rest)

        def one(say):
            known, z = build_problem(spectra, actuator, bench, names, tried, _density(start)) if posed is None else posed
            same = start is not None and start.problem.layout.density_unknowns == known.layout.density_unknowns
            weights = start.solution.weights if same else START_WEIGHTS[: len(known.penalties)]
            found = solve(
                known,
                z,
                weights,
                max_jacobians=choices.max_jacobians,
                target=target,
                progress=lambda k, c: say(f"fit from {rest}", k, c),
            )
            return known, found, tried

        return one

    ended = [run(rests[0], (problem, z))(report)]
    if not _settled(*ended[0][:2]) and not ended[0][1].interrupted:
        try:
            ended += together([run(rest) for rest in _apart((*rests, *others), problem)[1:]], report)
        except KeyboardInterrupt:
            known, found, tried = ended[0]
            ended = [(known, dataclasses.replace(found, converged=False, interrupted=True), tried)]
    return _best_memory([row for row in ended if row[2].rest not in others or _settled(*row[:2])])


def _strain(problem, solution) -> float:
    """Sum of the squared levels of the recordings, each in units of its prior: a wrong start memory strains them."""
    levels = solution.z[len(solution.z) - problem.layout.memories :]
    return float(levels @ levels)


def _settled(problem, solution) -> bool:
    """Whether no other start memory need be tried; levels that strain their prior tell of a wrong one even where the recordings
    are met."""
    return _strain(problem, solution) <= CALM * problem.layout.memories and solution.chi2 < REST_SETTLED * problem.data_count


def memory_is_told(result) -> bool:
    """Whether the recordings' levels say that their start memory is the right one: beside any other they are seldom calm."""
    memories = result.problem.layout.memories
    return memories > 0 and _strain(result.problem, result.solution) <= CALM * memories


def against_memory(fits) -> list[float]:
    """What speaks against the start memory of each fit of the same recordings: pairs of a problem and its solution.

    Chi2 and the levels' strain where the noise is met. What a density too coarse, or missing physics, leaves acts as further
    noise of the harmonics, as large as the best leaves: that one memory leaves a little less of it than another tells nothing,
    for each density bends to it in its own way. The levels of the right memory stay calm meanwhile; those of others are off by tens of
    their prior.
    """
    noise = max(1.0, min((found.chi2 / known.data_count for known, found in fits if np.isfinite(found.chi2)), default=1.0))
    against = [found.chi2 / noise + _strain(known, found) for known, found in fits]
    return [value if np.isfinite(value) else np.inf for value in against]


def _best_memory(ended):
    """Of fits from several start memories, (problem, solution, choices), the first that is settled, else the best."""
    for row in ended:
        if _settled(*row[:2]):
            return row
    return ended[int(np.argmin(against_memory([row[:2] for row in ended])))]


def _with_turning(z, solution, actuator, bench, names, choices, spectra, report, target):
    """The fit from loops whose M may turn its sign wherever the strain comes near zero, where that begins elsewhere and ends lower;
    None elsewhere. The strain goes by M^2: with the wrong sign of a loop's M no density serves, and no step leads to the right one."""
    again = dataclasses.replace(choices, touching=True)
    posed = build_problem(spectra, actuator, bench, names, dataclasses.replace(again, rest=rests_of(bench, again)[0][0]))
    if choices.touching or np.array_equal(z, posed[1]):
        return None
    found = _start_memories(*posed, actuator, bench, names, again, spectra, None, report, target)
    return found if found[1].chi2 < solution.chi2 else None


def _apart(rests, problem):
    """Those that are not the same as one before: where the bias is strong, what was demagnetized without it is saturated."""
    plane = problem.template.hysteresis
    fields = [field_of_rest(rest, problem.template, float(plane.low), float(plane.high)) for rest in rests]
    return [rest for k, rest in enumerate(rests) if fields[k] not in fields[:k]]


def _refine_density(problem, solution, actuator, bench, names, choices, spectra, report, highest):
    """A finer density where chi2 stays above the noise, chi2/N below `highest`, and it lowers it clearly."""
    count = problem.data_count
    for densities, least, takes in zip(finer_than(choices, bench), FINER_FROM, FINER_TAKES, strict=True):
        if not densities or not least < solution.chi2 / count < highest:
            continue
        # a finer density must take its share of the excess, and five standard deviations
        target = min(0.95 * count + takes * max(solution.chi2 - 0.95 * count, 0.0), solution.chi2 - 25)
        targets = [min(target, CELLS_MEET * count) if finer.knots is None else target for finer in densities]

        def tried(finer, target, known=problem, before=solution):
            return lambda say: _on_density(known, before, actuator, bench, names, finer, spectra, target, say)

        try:
            trials = together([tried(*pair) for pair in zip(densities, targets, strict=True)], report)
        except KeyboardInterrupt:
            return problem, dataclasses.replace(solution, interrupted=True), choices
        met = [trial for trial, target in zip(trials, targets, strict=True) if trial[1].chi2 < target]
        if met:
            problem, solution, choices = min(met, key=lambda trial: trial[1].chi2)
    return problem, solution, choices


def _on_density(problem, solution, actuator, bench, names, finer, spectra, target, report):
    """The fit with a finer density, from where that with the coarser one ended: (problem, solution, its choices)."""
    found, z = _resample(problem, solution, spectra, actuator, bench, names, finer)
    z = _with_parameters(found, z, problem, solution)
    weights = np.asarray(found.target.weights) if finer.knots is None else solution.weights  # of another basis
    trial = solve(
        found, z, weights, max_jacobians=finer.max_jacobians, target=target, progress=lambda k, c: report("finer density", k, c)
    )
    if trial.interrupted:
        raise KeyboardInterrupt
    return found, trial, finer


def finer_than(choices, bench) -> tuple:
    """The densities that may be tried after that of `choices`, those of one step side by side; () for steps that it has taken."""
    steps = FINER if bench.drive == "current" else FINER_MATERIAL
    steps = tuple(tuple(dataclasses.replace(choices, **row) for row in step) for step in steps)
    if choices.knots is None:
        return ((),) * len(steps)
    taken = [any(row.knots is not None and row.knots <= choices.knots for row in step) for step in steps]
    return tuple(() if done else step for step, done in zip(steps, taken, strict=True))


def hats_of_step(choices, bench, step: int) -> tuple:
    """The hats of a step of `FINER`; () where these have been taken, and for cells."""
    return tuple(row for row in finer_than(choices, bench)[step] if row.knots is not None)


def finest(choices) -> bool:
    """Whether no finer hats are tried than those of `choices`."""
    return choices.knots is not None and choices.knots >= FINER[-1][0]["knots"]


def cells_beside(choices) -> tuple:
    """Densities of a mass a cell to set beside one of hats; () where it is of cells itself."""
    return () if choices.knots is None else tuple(dataclasses.replace(choices, **row) for row in CELLS)


def finer_hats(choices) -> tuple:
    """The next finer hats; () after the finest, and where the density is of cells."""
    rows = (row for step in FINER for row in step if row["knots"] is not None and choices.knots is not None)
    return tuple(dataclasses.replace(choices, **row) for row in rows if row["knots"] > choices.knots)[:1]


def _with_parameters(new_problem, z, problem, solution):
    z = z.copy()
    for name in problem.layout.names:
        value = float(problem.layout.value(name, jnp.asarray(solution.z)))
        z[new_problem.layout.index(name)] = new_problem.layout.coordinate(name, value)
    return z


def _resample(problem, solution, spectra, actuator, bench, names, choices):
    """A problem with a finer density, started from the fitted parameters and the equation error under them."""
    values = {n: float(problem.layout.value(n, jnp.asarray(solution.z))) for n in names}
    return build_problem(spectra, actuator.replace(values), bench, names, choices)


_actuator_at = eqx.filter_jit(lambda layout, template, z: layout.actuator(template, z))  # one program, not one an operation


def finish(problem, solution, choices, bench, recordings, warm=0.0, target=np.inf) -> FitResult:
    """Estimates (quoted with a tenth of the roughness weights, but of a fit that missed its `target`), per-recording misfit, outcome."""
    fitted = _actuator_at(problem.layout, problem.template, jnp.asarray(solution.z))
    count = problem.data_count
    refined = solution
    if solution.chi2 / count < 20 and not solution.chi2 > target:
        refined = solve(problem, solution.z, UNDERSMOOTH * solution.weights, max_jacobians=4, evidence=False)
    quoted = _actuator_at(problem.layout, problem.template, jnp.asarray(refined.z))
    rows = estimates(problem, refined, quoted)
    residual = data_residual(problem, solution.z)
    per_recording = recording_fits(problem, residual, recordings, bench)
    cov = covariance(solution.normal, solution.z, problem.layout)
    effective = float(np.trace(cov @ (solution.normal - prior_matrix(problem, solution.weights))))
    chi2n = solution.chi2 / count
    related = correlations(problem, refined)
    message = (
        outcome(chi2n, per_recording, solution, rows, problem, choices.max_jacobians)
        + loose(rows)
        + valleys(related)
        + unsettled(problem.spectra)
        + guessed(recordings, bench)
        + strayed(recordings)
        + beyond_the_rod(problem.spectra, fitted, bench)
        + _contradicted(bench, choices)
    )
    lost = not chi2n < LOST or (chi2n > AT_BOUND and any(e.at_bound and not e.name.startswith("effects.") for e in rows))
    return FitResult(
        fitted, bench, bool(solution.converged) and not lost, message, tuple(rows), related, per_recording, float(chi2n), count,
        effective, float(solution.chi2 + effective * np.log(count)), solution.jacobians, warm, solution.seconds, problem, solution, refined,
        problem.spectra, choices,
    )  # fmt: skip


def beyond_the_rod(spectra, actuator, bench) -> str:
    """That a reading moves further than the rod can, in words, by recordings too slow for its resonance."""
    if bench.output != "displacement" or actuator.piezo is not None or actuator.mechanics is None:
        return ""
    reach, slow = float(actuator.strained.reach), SLOW * float(actuator.mechanics.f0)
    stroke = max((s.peak_to_peak for s in spectra if s.frequency < slow), default=0.0)
    if stroke <= MOST_STROKE * reach:
        return ""
    return (
        f"; the reading moves by {stroke:.3g} m, and the rod gives {reach:.3g} m at most (lambda_s l_rod): no parameter is physical; "
        "set scale or unit in [columns.displacement], or lambda_s and l_rod of the bench"
    )


def _contradicted(bench, choices) -> str:
    """A sentence where the recordings are met from another start than the bench states."""
    if bench.start not in RESTS or choices.rest in (*RESTS[bench.start], "held", "auto"):
        return ""
    met = "the demagnetized state" if choices.rest == "demagnetized" else f"{choices.rest} saturation"
    return f"; the recordings are not met from the start that the bench states, {bench.start}, but from {met}"


def recording_fits(problem, residual, recordings, bench):
    """Misfit of each recording from the whitened residual vector."""
    R, H = problem.target.lines.shape
    real = residual[: R * H].reshape(R, H)
    imag = residual[R * H :].reshape(R, H - 1)
    deviations = np.asarray(problem.target.deviations)
    rows = []
    for k, (recording, s) in enumerate(zip(recordings, problem.spectra, strict=True)):
        finite = np.isfinite(deviations[k])
        number = 2 * finite.sum() - finite[0]
        chi2 = float((real[k] ** 2).sum() + (imag[k] ** 2).sum())
        misfit = np.where(finite, deviations[k], 0.0)
        power = (real[k] * misfit) ** 2
        power[1:] = 2 * (power[1:] + (imag[k] * misfit[1:]) ** 2)
        between = float(np.mean(s.residue**2))
        rows.append(
            RecordingFit(
                recording.origin.get("file", recording.name) if "[" not in recording.name else recording.name,
                recording.origin.get("sha256", ""), bench.output, si_unit(bench.output),
                s.frequency, s.periods, s.noise_rms, float(np.sqrt(power.sum() + between)), chi2 / number,
            )
        )  # fmt: skip
    return tuple(rows)


def valleys(found) -> str:
    """The pairs of parameters that these recordings do not tell apart, in words: their priors do, if any."""
    named = {pair: value for pair, value in found.items() if LEARNED not in pair}
    pairs = [f"{' and '.join(pair.split('~'))} (correlation {value:.2f})" for pair, value in named.items() if abs(value) > VALLEY]
    return f"; a valley: only their priors part {', '.join(pairs)}" if pairs else ""


def loose(rows) -> str:
    """The parameters that these recordings do not hold, in words, and why."""
    loose = [e for e in rows if e.free and not e.identified]
    found = [f"{e.name} ({e.why})" for e in loose if not e.name.startswith(LEARNED)]
    held = "; a prior holds the coefficients of the learned term" if len(found) < len(loose) else ""
    return (f"; not identified: {', '.join(found)}" if found else "") + held


def guessed(recordings, bench) -> str:
    """That the noise of recordings without a repeat is a guess, in words."""
    number = sum(r.noise_is_a_guess(bench.output) for r in recordings)
    if not number:
        return ""
    return f"; the noise of {number} of {len(recordings)} recordings is a guess from their highest orders: record three or more periods"


def strayed(recordings) -> str:
    """Single samples that were put where the other periods are, in words."""
    found = {Path(r.name).name: stray_samples(r)[0] for r in recordings if stray_samples(r)[0]}
    if not found:
        return ""
    told = ", ".join(f"{name} ({number})" for name, number in list(found.items())[:3])
    return f"; samples that stood far off alone were left out: {told}{' and others' if len(found) > 3 else ''}"


def unsettled(spectra) -> str:
    """What was taken out of recordings that began before the mechanics had settled, in words."""
    starts = [float(np.abs(s.start).max()) for s in spectra if s.start is not None]
    if not starts:
        return ""
    return f"; {len(starts)} of {len(spectra)} recordings began unsettled: a decaying motion of up to {max(starts):.2g} m was taken out"


def outcome(chi2n, rows, solution, parameters, problem, limit=None) -> str:
    """What the fit means, with its remedy. `limit`: the Jacobians that it was given."""
    if solution.interrupted:
        return f"interrupted after {solution.jacobians} Jacobians; this is what was reached: give it as --model to go on from its constants"
    if not chi2n < LOST:
        wrong = swapped(problem.spectra, rows) or "check signs and units of the recordings, and the bench file"
        named = Path(max(rows, key=lambda r: np.nan_to_num(r.chi2_per_sample, nan=np.inf)).file).name
        size = (
            f"what repeats is {np.sqrt(chi2n):.3g} times its noise"
            if np.isfinite(chi2n)
            else "the simulation fails at its constants"
        )
        return f"the fit has led nowhere: {size} (worst: {named}); {wrong}"
    bound = [e.name for e in parameters if e.at_bound and not e.name.startswith("effects.")]  # where a law's shape ends it may stay
    if not solution.converged:
        after = f"stopped after {solution.jacobians} Jacobians before it settled"
        if bound:
            return f"{after}: {', '.join(bound)} sits at its bound; free another parameter or check signs, units and the bench file"
        if limit is not None and solution.jacobians < limit:
            return f"{after}: no step leads on from there; start nearer, hold a parameter or give it a prior (see the bench file)"
        return f"{after}; raise --max-jacobians or start nearer (see the bench file)"
    worst = max(rows, key=lambda r: r.chi2_per_sample)
    if bound:
        far = f", and what repeats is {np.sqrt(chi2n):.3g} times its noise (worst: {Path(worst.file).name})" if chi2n > 2 else ""
        return f"{', '.join(bound)} sits at its bound{far}; free another parameter or check signs, units and the bench file"
    if chi2n < 1.1 and worst.chi2_per_sample < 1.6:
        return "the recordings are met to their noise; the error bars hold"
    if chi2n > 2:
        return (
            f"what repeats is {np.sqrt(chi2n):.1f} times its noise (worst: {worst.frequency:.4g} Hz), so the error bars do not hold and no "
            "parameter is physical yet; run magjax diagnose on the same files"
        )
    alone = f", and {worst.chi2_per_sample:.3g} in {Path(worst.file).name}" if chi2n < 1.1 else ""
    return (
        f"chi2/N = {chi2n:.2f}{alone}, a little above the noise; the error bars are too narrow: a rough density, or a weak effect "
        "(magjax diagnose tells which)"
    )
