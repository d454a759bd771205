"""diagnose(recordings, bench): where simulation and recordings differ, what physics was left out, and the repaired model.

Order: data first, then the base fit to its floor, record-level effects between the harmonics, the screening of the
catalogue off the full tangent space, real fits of the leaders, groups, checks, the next experiment, the verdict.
"""

import contextlib
import dataclasses
import functools

import numpy as np

from magjax.bench import load_bench
from magjax.effects import CLASSES

from .alternation import alternating
from .attribute import FEEDBACKS, LIKE_DENSITY, MIN_DROP
from .beginning import Anew, Beginning
from .diagnosis import Diagnosis, Evidence
from .floors import data_problem, solver_floor, wrong_bench
from .instruments import diagnose_beyond, known_instruments
from .learned_verdict import LEAVES_MISFIT, MANY, better_learned, with_learned_term
from .locate import where
from .memories import STATES
from .missed_check import with_missed_check
from .own_signals import (
    drifts_of_one,
    needless_zeros,
    record_level,
    sensor_zero,
    with_zero,
)
from .plain import plain_there, screened_finer
from .record_level import remove_from_checks
from .rough import beside_cells, is_rough, on_better_density, on_cells_alone, without_chance, worth_a_search
from .rows import DRIFTS, led_by_drifts
from .screen import screened
from .search import search
from .setup import Choices, spectra_of, with_held_masses
from .spoilt import FAR, spoilt
from .still import moving_and_still, word_on
from .task import Clock, Late, Task
from .told_memory import told_by_checks
from .verdict import Z_THRESHOLD, first_alone, unexplained, verdict, without_worse

ABSORBED_VISIBILITY = 0.004
LATE_TEXT = (
    "The limit of {:g} min (--minutes of magjax diagnose; in its last two fifths nothing is begun anew, and the last is kept for a function "
    "learned where effects explain too little) left out what was still to be tried; "
    "with more time it may find more, or rivals to what it names."
)
MEMORY_TEXT = "The recordings of the fit do not tell their start memory; the check recordings do: {}."


def diagnose(
    recordings,
    bench,
    *,
    check=(),
    calibration=(),
    actuator=None,
    choices: Choices = Choices(),
    progress=None,
    minutes: float = np.inf,
) -> Diagnosis:
    """Diagnose recordings (`Recording`s of drives that repeat) against a bench; `check`: recordings that take no part in any fit;
    `actuator`: what the plain model starts from, with effects that belong to it, None for the bench's constants; `choices`: how
    fits are set up, and the effects that alone are asked for.

    Recordings that hold the command beside a measured current, and `calibration`s of the sensor (reference displacement and
    reading), settle those instruments by themselves. `progress` is called as progress(text, step, chi2 per datum).
    `minutes`: after them, from the beginning, the search for effects ends with what it has found; the plain fit before it is
    waited for; from three fifths of the time on nothing is begun anew, and the last is kept for a function learned where effects
    explain too little. `ended_after` of the diagnosis tells.
    Returns a `Diagnosis`; raises `RecordingError` where a recording cannot be used at all and `ConfigurationError` for a wrong
    bench.
    """
    bench = load_bench(bench)
    recordings, check = list(recordings), list(check)
    choices = with_held_masses(choices, bench, actuator)
    recordings, still = moving_and_still(recordings, bench)
    if still:
        note = word_on(Task(tuple(recordings), bench, choices, progress, actuator).fit(), recordings, still, bench)
        same = {"actuator": actuator, "choices": choices, "progress": progress, "minutes": minutes}
        return diagnose(recordings, bench, check=check, calibration=calibration, **same).noted(note)
    if known := known_instruments(recordings, calibration, bench):
        within = functools.partial(diagnose, minutes=minutes)
        return diagnose_beyond(known, within, recordings, bench, check, actuator, choices, progress)
    task = Task(tuple(recordings), bench, choices, progress, actuator, Clock(minutes))
    found = _with_asked(with_missed_check(task, _diagnosed(task, check), check, _diagnosed), choices.only)
    return dataclasses.replace(found.noted(LATE_TEXT.format(minutes)), ended_after=minutes) if task.clock.cut else found


def _with_asked(found, only) -> Diagnosis:
    """The diagnosis with the effects that alone were asked for, and a word on those that say nothing on this bench."""
    idle = [n for n in only if found.candidates and n not in {c.name for c in found.candidates} and not CLASSES[n].record_level]
    found = dataclasses.replace(found, asked=only)
    return found.noted(f"{' and '.join(idle)} cannot be asked for on this bench.") if idle else found


def _diagnosed(task, check) -> Diagnosis:
    """The diagnosis of the task's recordings, whose instruments are not known from channels of their own."""
    recordings, bench, choices = list(task.recordings), task.bench, task.choices
    task.say("between the harmonics")
    spectra = spectra_of(recordings, bench, choices.harmonics)
    if alternation := alternating(recordings, spectra, bench.output):
        return alternation.told(_diagnosed(task.on(recordings=tuple(alternation.cleaned)), check))
    problem = data_problem(recordings, spectra, bench.output)
    recordings, drifting = drifts_of_one(recordings, spectra, bench)
    spectra = spectra_of(recordings, bench, choices.harmonics) if drifting else spectra
    adopted, cleaned = record_level(recordings, spectra, bench, choices)
    if problem and (not adopted or data_problem(cleaned, spectra_of(cleaned, bench, choices.harmonics), bench.output)):
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=task.fit(refine=False))
    found = _examined(Beginning(task.on(recordings=tuple(cleaned)), task, tuple(adopted), check))
    found = functools.reduce(Diagnosis.noted, drifting, found)
    if not problem:
        return found
    names = " and ".join("the drift" if effect.name in DRIFTS else effect.name for effect, _ in adopted)
    return dataclasses.replace(found, message=f"{found.message} As recorded, before {names} was taken out: {problem}.")


def _examined(begun: Beginning) -> Diagnosis:
    """The diagnosis of recordings without record-level effects."""
    first, plain = begun.plain is None, begun.task.fit() if begun.plain is None else begun.plain
    try:
        far = plain.chi2_per_sample > FAR
        suspect = _spoilt(begun.task, plain) if first and far else None
        if suspect is None or not suspect.certain:
            found = _explained(begun.on(plain=plain))
            if not first or found.verdict != "unknown_at":
                return found
            suspect = suspect if far else _spoilt(begun.task, plain)
        if suspect is None:
            return found
        if suspect.certain:
            return Diagnosis("data_problem", f"{suspect.told}.", data_problem=suspect.told, base=plain)
        return found.noted(f"{suspect.told}.")
    except KeyboardInterrupt as stop:  # what was reached
        stop.plain = getattr(stop, "plain", plain)
        raise


def _spoilt(task, plain):
    """What speaks against the recordings; None where nothing does, where a sign is swapped, which is told by itself, or no time is
    left to ask."""
    with contextlib.suppress(Late):
        if wrong_bench(plain):
            return None
        return spoilt(task.sparing, plain)
    return None


def _explained(begun: Beginning) -> Diagnosis:
    """The diagnosis from the plain fit on."""
    task, plain = begun.task, begun.plain
    if problem := wrong_bench(plain):
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=plain)
    candidates = screened(plain, task.choices)
    if cleaned := begun.from_plain(plain, candidates):
        return _examined(cleaned)
    plain, candidates, zero, rival = sensor_zero(task, plain, candidates)
    if zero is None and (freed := begun.with_own_means(plain, candidates)):
        return _examined(freed)
    free = task.held if zero is None else (*task.held, "sensor.offset")
    plain, candidates = screened_finer(task, plain, candidates, free)
    begun = begun.on(plain=plain)
    raw = begun.measured.fit(extra=free, choices=plain.choices, refine=False) if begun.adopted else plain
    place = where(plain, candidates, task.recordings, task.bench.output)
    checks = begun.check, remove_from_checks(begun.check, [e for e, _ in begun.adopted], task.bench)
    anew = Anew(begun, candidates, zero is not None)
    reached = search(task.searching, plain, worth_a_search(plain, candidates), checks[1], anew, anew.means)
    if anew.found:
        return _examined(anew.found)
    if before := _with_needed_means(begun, reached):
        return _examined(before)
    told = None
    with contextlib.suppress(Late):
        told = told_by_checks(task.sparing, reached.current, reached.foretell)
    if told is not None:
        if remembered := _remembered(begun, told) if reached.steps and zero is None else None:
            found = _examined(remembered)
            if not lost_there(found, told):
                return _with_memory(found, told)
        plain, raw = (plain, raw) if reached.steps else (told, raw if begun.adopted else told)
        reached = dataclasses.replace(reached, current=told)
    evidence = Evidence(
        reached, begun.adopted, raw, plain, tuple(candidates), task.recordings, task.bench, checks, _floors(plain), place,
        _absorbed(candidates, reached.tried), task.choices.only,
    )  # fmt: skip
    return _with_memory(with_zero(_concluded(task, led_by_drifts(evidence)), zero, rival), told)


def _with_needed_means(begun, reached) -> Beginning | None:
    """From before means of the recordings were set free, where what was found does not need that; None elsewhere."""
    before = begun.before_means
    with contextlib.suppress(Late):
        if before and needless_zeros(before.task.sparing, reached):
            return before.on(plain=None, means=False)
    return None


def _remembered(begun, told) -> Beginning | None:
    """From the start memory that check recordings told, where the plain fit leaves less from there; None elsewhere."""
    task = begun.task
    with contextlib.suppress(Late):
        if other := plain_there(task.sparing, begun.plain, told):
            return begun.on(task=task.on(choices=dataclasses.replace(task.choices, rest=told.choices.rest)), plain=other)
    return None


def lost_there(found, told) -> bool:
    """Whether a diagnosis from the start memory that was told has lost the effects that a fit from there still holds: it ends in
    `unknown_at`, and leaves more than `told` does."""
    return found.verdict == "unknown_at" and (found.repaired or found.base).chi2_per_sample > told.chi2_per_sample


def _with_memory(found, told) -> Diagnosis:
    """The diagnosis with a word on the start memory that check recordings told, if they did."""
    return found if told is None else found.noted(MEMORY_TEXT.format(STATES[told.choices.rest]))


def _concluded(task, evidence) -> Diagnosis:
    """The verdict; where no effect explains the misfit, a rough density's or with a function learned in its place. Once the time is
    over, without what takes another fit."""
    evidence = without_chance(evidence)
    found = verdict(evidence)
    with contextlib.suppress(Late):
        return _thorough(task.timed, evidence, found)
    if found.verdict == "unknown_at":
        return verdict(evidence, rough=True) if is_rough(evidence, found.check) else without_worse(evidence, found)
    return found


def _thorough(task, evidence, found) -> Diagnosis:
    """What fits make of a verdict."""
    if rough := found.verdict == "unknown_at" and is_rough(evidence, found.check):
        found = verdict(evidence, rough=True)
    elif found.verdict in ("unknown_at", "attributed", "group") and (rougher := on_cells_alone(task, evidence)):
        return verdict(rougher, rough=True)
    if found.verdict == "unknown_at" and not rough and (rougher := beside_cells(task, evidence)):
        return verdict(rougher, rough=True)
    if found.verdict == "unknown_at":
        found = without_worse(evidence, found)
        return with_learned_term(found, evidence.plain, evidence.recordings, evidence.bench, evidence.checks[1], task.progress)
    if (rough or found.repaired is not None) and (finer := on_better_density(task, evidence)):
        again = verdict(finer)
        again = verdict(finer, rough=True) if rough and again.verdict != found.verdict else again
        found = again if again.verdict == found.verdict else found
    if not rough and (learned := _wrong_name(task, evidence, found)):
        found = unexplained(evidence, found)
        return with_learned_term(found, evidence.plain, evidence.recordings, evidence.bench, evidence.checks[1], learned=learned)
    return found


def _wrong_name(task, evidence, found):
    """A learned term that serves better than the effects that were named, in another block, where these leave a misfit, or one that
    serves as well as `MANY`; None elsewhere."""
    alone = evidence if len(evidence.reached.steps) == 1 else first_alone(evidence)
    named = alone if alone is not None and found.repaired is alone.reached.current else evidence
    steps, current = named.reached.steps, named.reached.current
    if found.verdict not in ("attributed", "group") or not steps:
        return None
    if not found.repaired.chi2_per_sample > LEAVES_MISFIT and len(steps) < MANY:
        return None
    blocks = {t.candidate.block for _, rivals, *_ in steps for t in rivals}
    about = evidence.recordings, evidence.bench, len(steps), evidence.checks[1], task.progress
    return better_learned(evidence.plain, current, blocks, *about)


def _absorbed(candidates, tried) -> tuple[str, ...]:
    """What these recordings could not show: the density makes nearly all of it, or bends to it beyond what its column tells. What
    scores, or took its share in a fit, did show. `tried`: candidates that were fitted, by name."""
    shown = {name for name, c in tried.items() if (c.achieved_chi2_drop or 0.0) > MIN_DROP}
    silent = [c for c in candidates if abs(c.z) < Z_THRESHOLD and c.name not in shown]
    return tuple(c.name for c in silent if c.visibility < ABSORBED_VISIBILITY or c.name in (*LIKE_DENSITY, *FEEDBACKS))


def _floors(result) -> dict:
    """Noise, solver and density, rms in the unit of the reading."""
    noise = result.problem.noise_rms
    above = max(result.chi2_per_sample - 1, 0) / max(np.median([s.samples for s in result.spectra]), 1)
    return {
        "noise_rms": noise,
        "solver_rms": solver_floor(result.problem, result.solution),
        "density_rms": float(noise * np.sqrt(above)),
    }
