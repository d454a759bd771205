"""fit(recordings, bench): the joint fit as users call it, its start memories and its density."""

import dataclasses
import functools
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from magjax.bench import load_bench
from magjax.simulate import require_x64

from .finer import (
    CELLS_MEET,
    FINER_FROM,
    FINER_TAKES,
    REFINE_BELOW,
    REFINE_BESIDE,
    REFINE_MATERIAL,
    STEPS_FROM,
    finer_than,
    has_steps,
    hats_of_step,
)
from .joint import compiled, data_residual, prior_matrix, solve
from .memories import apart, believed, best_memory, is_strained, rests_of, settled
from .outcome import (
    AT_BOUND,
    LOST,
    beyond_the_rod,
    contradicted,
    guessed,
    loose,
    outcome,
    recording_fits,
    strayed,
    unsettled,
    valleys,
)
from .result import FitResult, Quoted
from .settling import periods_asked
from .setup import EDDY_EFFECT, Choices, build_problem, free_parameters, spectra_of, with_held_masses
from .steps import stepped
from .together import together
from .uncertainty import UNDERSMOOTH, correlations, covariance, estimates

ASTRAY = 1e3  # chi2/N from which the signs of M in the loops that a fit began with are in doubt
UNSETTLED = 1.5  # times its target, up to which a fit to what had not settled is asked whether more periods bring it there
BRIEF = 5  # Jacobians that come near enough to tell how long a fit takes to settle


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
    patient: bool = True,
) -> FitResult:
    """Fit an actuator to recordings jointly.

    `recordings`: `Recording`s of drives that repeat; `bench`: a `Bench` or its name; `actuator`: start (the bench's constants
    if None), effects included; `extra`: names of further free parameters; `choices`: density, grids and limits; `refine`:
    let a finer density be chosen where the misfit asks for it, or up to what chi2/N.
    Masses that `bench.free` does not name are held at those of `actuator`, with its start memory.
    `progress`: called as progress(text, step, chi2 per datum); `target`: a total chi2 above which the fit is of no use and may
    end early; `spectra`: those of the recordings, where another fit of the same has them; `start`: a fit whose density and
    weights are gone on from; `patient`: with more periods, too, where it has used up its Jacobians without them.
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
    problem, solution, choices = _start_memories(problem, z, actuator, bench, names, asked, spectra, start, report, target, patient)
    if start is None and solution.chi2 > ASTRAY * problem.data_count and not solution.interrupted:
        asked = dataclasses.replace(asked, periods=choices.periods)
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


def _changes_scale(bench, names, start) -> bool:
    """Whether a first eddy loss is asked for where the field is known: the density learned without it holds its width."""
    return bench.drive == "field" and EDDY_EFFECT in names and EDDY_EFFECT not in start.problem.layout.names


def _weights(start, problem, choices) -> np.ndarray:
    """Roughness weights to begin with: those of a fit to go on from, of its families where it is of other hats, of which they are
    nearly the same; else those that all fits begin with."""
    if start is None or (start.choices.knots is None) != (choices.knots is None):
        return np.asarray(problem.target.weights)
    if start.problem.layout.density_unknowns == problem.layout.density_unknowns and start.problem.stiffness is problem.stiffness:
        return start.solution.weights
    if choices.knots is None or problem.stiffness is not None:
        return np.asarray(problem.target.weights)
    return _of_families(start.problem, start.solution)


def _of_families(problem, solution) -> np.ndarray:
    """Roughness weights of the families of differences, where these have weights of their own, too."""
    return solution.weights if problem.stiffness is None else problem.stiffness.weights


def _density(start):
    """Basis, density unknowns and bottom of a fit, as `build_problem` goes on from; None for None."""
    return None if start is None else _density_of(start.problem, start.solution)


def _density_of(problem, solution):
    return problem.basis, solution.z[: problem.layout.density_unknowns + 1]


def _start_memories(problem, z, actuator, bench, names, choices, spectra, start, report, target, patient: bool = True):
    """The fit from each start memory until one meets the noise; the best of them. The first by itself, then the others side by side.

    One that the bench does not state is taken only where it meets the noise and none that it states does: `believed`. Where the best has levels
    far from their prior, a right one may have ended in a false valley: from there the others are tried once more.
    """
    rests, others = rests_of(bench, choices)
    build = functools.partial(build_problem, spectra, actuator, bench, names)

    def run(rest, posed=None):
        tried = dataclasses.replace(choices, rest=rest)
        return lambda say: _solved(build, *(posed or build(tried, _density(start))), tried, start, target, say, patient)

    ended = [run(rests[0], (problem, z))(report)]
    if not settled(*ended[0][:2]) and not ended[0][1].interrupted:
        ended = _beside(ended[0], [run(rest) for rest in apart((*rests, *others), problem)[1:]], report)
    best = best_memory(believed(ended, rests))
    if start is None and len(ended) > 1 and is_strained(*best[:2]):
        again = [row[2].rest for row in ended if row[2].rest in rests and row[1].chi2 > best[1].chi2]
        best = best_memory(_beside(best, [_from_there(best, rest, actuator, bench, names, spectra) for rest in again], report))
    return best


def _beside(first, runs, report):
    """A fit, (problem, solution, choices), and those of the runs, side by side; after Ctrl-C the first alone, as one that was interrupted."""
    try:
        ended = [first, *together(runs, report)]
    except KeyboardInterrupt:
        ended = []
    if ended and not any(solution.interrupted for _, solution, _ in ended):
        return ended
    problem, solution, choices = first
    return [(problem, dataclasses.replace(solution, converged=False, interrupted=True), choices)]


def _from_there(best, rest, actuator, bench, names, spectra):
    """The fit from another start memory and the density that one ended with, its own having led nowhere; levels from their mean."""
    problem, solution, choices = best
    choices = dataclasses.replace(choices, rest=rest)
    found, z = _resample(problem, solution, spectra, actuator, bench, names, choices)
    z[len(z) - found.layout.memories :] = 0.0

    def run(say):
        progress = functools.partial(say, f"fit from {rest}")
        return found, solve(found, z, solution.weights, max_jacobians=choices.max_jacobians, progress=progress), choices

    return run


def _solved(build, problem, z, choices, start, target, say, patient: bool = True):
    """A problem solved from z, with as many periods as it takes until they repeat: (problem, solution, choices).

    Where they do not, it begins anew with more, and a few Jacobians from there tell whether these are enough. A fit that goes on from
    another, `start`, has its periods, and goes on with more where it is of use, or may come to be; if it is not `patient`, and has not
    converged with those, whoever asked for it says whether it is."""
    at, chi2 = z, None
    while True:
        while start is None and (periods := periods_asked(problem, at, chi2)) != problem.predictors[0].periods_of_each:
            choices = dataclasses.replace(choices, periods=periods)
            problem, z = build(choices)
            brief = solve(
                problem, z, _weights(None, problem, choices), max_jacobians=BRIEF,
                progress=functools.partial(say, f"until {max(periods)} periods repeat"),
            )  # fmt: skip
            if brief.interrupted:
                return problem, brief, choices
            at, chi2 = brief.z, brief.chi2
        found = solve(
            problem,
            z,
            _weights(start, problem, choices),
            max_jacobians=choices.max_jacobians,
            target=target,
            progress=functools.partial(say, f"fit from {choices.rest}"),
        )
        waits = patient or found.converged or found.chi2 > target
        if found.interrupted or (start is not None and (found.chi2 > UNSETTLED * target or not waits)):
            return problem, found, choices
        at, chi2 = found.z, found.chi2
        periods = periods_asked(problem, at, chi2)
        if periods == problem.predictors[0].periods_of_each:
            return problem, found, choices
        if start is not None:
            choices, z = dataclasses.replace(choices, periods=periods), at
            problem, _ = build(choices, _density(start))


def _with_turning(z, solution, actuator, bench, names, choices, spectra, report, target):
    """The fit from loops whose M may turn its sign wherever the strain comes near zero, where that begins elsewhere and ends lower;
    None elsewhere. The strain goes by M^2: with the wrong sign of a loop's M no density serves, and no step leads to the right one."""
    again = dataclasses.replace(choices, touching=True)
    posed = build_problem(spectra, actuator, bench, names, dataclasses.replace(again, rest=rests_of(bench, again)[0][0]))
    if choices.touching or np.array_equal(z, posed[1]):
        return None
    found = _start_memories(*posed, actuator, bench, names, again, spectra, None, report, target)
    return found if found[1].chi2 < solution.chi2 else None


def _refine_density(problem, solution, actuator, bench, names, choices, spectra, report, highest):
    """A finer density where chi2 stays above the noise, chi2/N below `highest`, and it lowers it clearly."""
    count = problem.data_count

    def best(densities, takes, problem, solution, choices):
        """Of those that take their share of the excess, and five standard deviations, the one that leaves least."""
        target = min(0.95 * count + takes * max(solution.chi2 - 0.95 * count, 0.0), solution.chi2 - 25)
        targets = [min(target, CELLS_MEET * count) if finer.knots is None else target for finer in densities]

        def tried(finer, target):
            return lambda say: _on_density(problem, solution, actuator, bench, names, finer, spectra, target, say)

        try:
            trials = together([tried(*pair) for pair in zip(densities, targets, strict=True)], report)
        except KeyboardInterrupt:
            return problem, dataclasses.replace(solution, interrupted=True), choices
        met = [trial for trial, target in zip(trials, targets, strict=True) if trial[1].chi2 < target]
        return min(met, key=lambda trial: trial[1].chi2, default=(problem, solution, choices))

    for densities, least, takes in zip(finer_than(choices, bench), FINER_FROM, FINER_TAKES, strict=True):
        if densities and least < solution.chi2 / count < highest and not solution.interrupted:
            problem, solution, choices = best(densities, takes, problem, solution, choices)
    little = STEPS_FROM < solution.chi2 / count < min(FINER_FROM[1], highest) and not solution.interrupted
    hats = hats_of_step(choices, bench, 1)
    if little and hats and has_steps(hats[0], bench):  # it may be steps that need more knots
        problem, solution, choices = best(hats, FINER_TAKES[1], problem, solution, choices)
    if choices.cells is not None and STEPS_FROM < solution.chi2 / count < highest and not solution.interrupted:
        problem, solution = stepped(problem, solution, functools.partial(report, "steps of the density"))
        choices = dataclasses.replace(choices, stiffness=problem.stiffness)
    return problem, solution, choices


def _on_density(problem, solution, actuator, bench, names, finer, spectra, target, report):
    """The fit with a finer density, from where that with the coarser one ended, with steps where these take what it leaves:
    (problem, solution, its choices)."""
    found, z = _resample(problem, solution, spectra, actuator, bench, names, finer)
    weights = np.asarray(found.target.weights) if finer.knots is None else _of_families(problem, solution)  # of another basis
    say = functools.partial(report, "finer density")
    steps = has_steps(finer, bench)
    useful = solution.chi2 + max(solution.chi2 - problem.data_count, 0.0) if steps else target  # steps may yet take it
    trial = solve(found, z, weights, max_jacobians=finer.max_jacobians, target=useful, progress=say)
    if steps and not trial.interrupted and trial.chi2 < useful:
        found, trial = stepped(found, trial, say)
        finer = dataclasses.replace(finer, stiffness=found.stiffness)
    if trial.interrupted:
        raise KeyboardInterrupt
    return found, trial, finer


def _resample(problem, solution, spectra, actuator, bench, names, choices):
    """A problem with a finer density, started from what was fitted."""
    values = {n: float(problem.layout.value(n, jnp.asarray(solution.z))) for n in names}
    found, z = build_problem(spectra, actuator.replace(values), bench, names, choices, _density_of(problem, solution))
    for name, value in values.items():  # a start from the equation error has a scale of its own
        z[found.layout.index(name)] = found.layout.coordinate(name, value)
    z[len(z) - found.layout.memories :] = solution.z[len(solution.z) - problem.layout.memories :]
    return found, z


_actuator_at = eqx.filter_jit(lambda layout, template, z: layout.actuator(template, z))  # one program, not one an operation


def finish(problem, solution, choices, bench, recordings, warm=0.0, target=np.inf) -> FitResult:
    """Per-recording misfit and the outcome; what is quoted, of a fit that missed its `target` (total chi2) too, waits until it is
    asked for. `warm`: s spent on compiling."""
    fitted = _actuator_at(problem.layout, problem.template, jnp.asarray(solution.z))
    count = problem.data_count
    residual = data_residual(problem, solution.z)
    per_recording = recording_fits(problem, residual, recordings, bench)
    cov = covariance(solution.normal, solution.z, problem.layout)
    effective = float(np.trace(cov @ (solution.normal - prior_matrix(problem, solution.weights))))
    chi2n = solution.chi2 / count
    quote = functools.partial(_quoted, problem, solution, choices, bench, recordings, fitted, per_recording, target)
    at_bound = chi2n > AT_BOUND and any(e.at_bound and not e.name.startswith("effects.") for e in quote().estimates)
    lost = not chi2n < LOST or at_bound
    return FitResult(
        fitted, bench, bool(solution.converged) and not lost, per_recording, float(chi2n), count, effective,
        float(solution.chi2 + effective * np.log(count)), solution.jacobians, warm, solution.seconds, problem, solution, quote,
        problem.spectra, choices,
    )  # fmt: skip


def _quoted(problem, solution, choices, bench, recordings, fitted, per_recording, target) -> Quoted:
    """The parameters with a tenth of the roughness weights (but of a fit that missed its `target`), and the outcome in words."""
    chi2n = solution.chi2 / problem.data_count
    refined, stopped = solution, False
    if chi2n < 20 and not solution.chi2 > target:
        found = solve(problem, solution.z, UNDERSMOOTH * solution.weights, max_jacobians=4, evidence=False)
        refined, stopped = (solution, True) if found.interrupted else (found, False)
    rows = estimates(problem, refined, _actuator_at(problem.layout, problem.template, jnp.asarray(refined.z)))
    related = correlations(problem, refined)
    message = (
        outcome(chi2n, per_recording, solution, rows, problem, choices.max_jacobians)
        + loose(rows)
        + valleys(related)
        + unsettled(problem.spectra)
        + guessed(recordings, bench)
        + strayed(recordings)
        + beyond_the_rod(problem.spectra, fitted, bench)
        + contradicted(bench, choices)
    )
    return Quoted(refined, tuple(rows), related, message, stopped)
