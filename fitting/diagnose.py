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
from .attribute import (
    FEEDBACKS,
    LIKE_DENSITY,
    MIN_DROP,
    MISFIT,
    chi2_of,
    excess_of,
)
from .check import check_errors
from .diagnosis import Diagnosis, Evidence, misfit
from .finer import FINER_FROM, FINEST_BELOW, REFINE_BELOW, finer_hats, finest, hats_of_step
from .floors import data_problem, solver_floor, wrong_bench
from .instruments import diagnose_beyond, known_instruments
from .learned import MANY, better_learned, with_learned_term
from .locate import where
from .memories import STATES
from .own_signals import (
    drifts_of_one,
    heat_on_harmonics,
    hum_on_harmonics,
    needless_zeros,
    own_zeros,
    record_level,
    sensor_zero,
    unsettled_means,
    with_zero,
)
from .reach import BEYOND
from .record_level import remove_from_checks
from .rough import beside_cells, is_rough, on_better_density, on_cells_alone, without_chance, worth_a_search
from .rows import DRIFTS, led_by_drifts
from .screen import screened
from .search import search
from .setup import Choices, spectra_of, with_held_masses
from .spoilt import FAR, mended_by, spoilt
from .task import Clock, Late, Task
from .told_memory import told_by_checks
from .verdict import HALF, WORSE, Z_THRESHOLD, first_alone, unexplained, verdict, without_worse

ABSORBED_VISIBILITY = 0.004
UNPROMISED = 3.0  # times what any effect promised, that effects take where the plain fit is tried from where they led
VALLEY = 0.3  # of what they take, that the plain fit must fall by from there
COARSE = 0.5  # of a misfit, that a finer density may leave where the first one was too coarse
LEAVES_MISFIT = 1.5  # chi2/N beside an effect that was named, from which a learned function is tried in its place
MISSED = 5.0  # times its noise, by which a check recording is not foretold though the fit meets its own,
GROSS = 0.1  # of its range, by which a check recording is missed that may be wrong itself
EXPECTED = 1.5  # beyond so many times what it expects for cells that no recording switched
UNSEEN_TEXT = "Check recordings are missed, times their noise: {}; about as the fit expects, for they switch cells that no recording did."
ALL_BUT = 0.05  # share of a misfit that the finest hats may leave to be gone on with up to FINEST_BELOW
FINEST_LEAVE = 0.9  # the same of the finest hats, where those before have taken their share already
LATE_TEXT = (
    "The limit of {:g} min (--minutes of magjax diagnose; in its last two fifths nothing is begun anew) left out what was still to be tried; "
    "with more time it may find more, or rivals to what it names."
)
MEMORY_TEXT = "The recordings of the fit do not tell their start memory; the check recordings do: {}."
UNEXPLAINED = 60.0  # chi2/N below which a finer density is tried where no candidate would take half of the excess


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
    waited for, and from three fifths of the time on nothing is begun anew. `ended_after` of the diagnosis tells.
    Returns a `Diagnosis`; raises `RecordingError` where a recording cannot be used at all and `ConfigurationError` for a wrong
    bench.
    """
    bench = load_bench(bench)
    recordings, check = list(recordings), list(check)
    choices = with_held_masses(choices, bench, actuator)
    if known := known_instruments(recordings, calibration, bench):
        within = functools.partial(diagnose, minutes=minutes)
        return diagnose_beyond(known, within, recordings, bench, check, actuator, choices, progress)
    task = Task(tuple(recordings), bench, choices, progress, actuator, Clock(minutes))
    found = _with_asked(_with_missed_check(task, _diagnosed(task, check), check), choices.only)
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
    found = _examined(task.on(recordings=tuple(cleaned)), task, adopted, check)
    found = functools.reduce(Diagnosis.noted, drifting, found)
    if not problem:
        return found
    names = " and ".join("the drift" if effect.name in DRIFTS else effect.name for effect, _ in adopted)
    return dataclasses.replace(found, message=f"{found.message} As recorded, before {names} was taken out: {problem}.")


def _with_missed_check(task, found, check) -> Diagnosis:
    """The diagnosis; where the fit meets its noise and misses a check recording by far, that one joins the recordings, if
    others are left to check: what it shows they may not reach. What is named with it must foretell the others no worse.
    """
    known = found.verdict in ("attributed", "group", "nothing_missing") and not any(r.get("joined") for r in found.check)
    if not known or not check or len(found.check) != len(check):
        return found
    if not (found.repaired or found.base).chi2_per_sample < MISFIT:
        return found
    ratios = [_surprise(r) for r in found.check]
    if not max(ratios, default=0.0) > MISSED:
        return _with_unseen_cells(found)
    worst = int(np.argmax(ratios))
    missed, left = check[worst], [c for k, c in enumerate(check) if k != worst]
    name = missed.origin.get("file", missed.name).rsplit("/", 1)[-1]
    if why := _contradiction(found, found.check[worst], missed, task.bench):
        return found.noted(f"The check recording {name} contradicts the others: {why}; correct it or leave it out.")
    told = f"{name} is missed by {ratios[worst]:.0f} times its noise, though the fit meets its own"
    if not left:
        return found.noted(f"{told}: the recordings do not reach what it shows; give it as one of them, and others to check.")
    with contextlib.suppress(Late):
        task.sparing.say(f"with {name} among the recordings")
        again = _diagnosed(task.on(recordings=(*task.recordings, missed)), left)
    if task.clock.cut:
        return found.noted(f"{told}: there was no time to ask for what it shows beside the recordings.")
    rest = [r for k, r in enumerate(found.check) if k != worst]
    met = again.verdict in ("attributed", "group") and again.repaired.chi2_per_sample < MISFIT
    before, after = misfit(rest, "rms_after"), misfit(again.check, "rms_after")
    if not met or not _says_more(again, found) or after > WORSE[0] * before + WORSE[1] * len(rest):
        return found.noted(f"{told}: the recordings do not reach what it shows, a density or physics; record more like it.")
    row = {**found.check[worst], "rms_after": again.repaired.recordings[-1].residual_rms, "joined": True}
    again = dataclasses.replace(again, check=(*again.check[:worst], row, *again.check[worst:]))
    return again.noted(f"Without it among the recordings {told}; it joined them.")


def _contradiction(found, row, recording, bench) -> str | None:
    """What is wrong with a check recording that is missed grossly, in words; None where no one number mends it."""
    if not row["rms_after"] > GROSS * np.ptp(recording.channels[bench.output]):
        return None
    return mended_by((found.repaired or found.base).actuator, recording, bench)


def _with_unseen_cells(found) -> Diagnosis:
    """The diagnosis with a word on check recordings within the plane that are missed by far, as the fit expects."""
    within = [r for r in found.check if r["noise_rms"] and r["beyond_plane"] <= BEYOND]
    rows = [(r["file"].rsplit("/", 1)[-1], r["rms_after"] / r["noise_rms"]) for r in within]
    far = [f"{name} by {ratio:.0f}" for name, ratio in rows if ratio > MISSED]
    return found.noted(UNSEEN_TEXT.format(", ".join(far))) if far else found


def _surprise(row) -> float:
    """How many times its noise a check recording is missed by; 0 where the fit expected as much, or its drive leaves the plane."""
    if not row["noise_rms"] or row["beyond_plane"] > BEYOND or row["rms_after"] < EXPECTED * (row.get("expected_rms") or 0.0):
        return 0.0
    return row["rms_after"] / row["noise_rms"]


def _says_more(again, found) -> bool:
    """Whether a diagnosis names more, or the same with fewer doubts."""
    number, before = (len(d.effects) + len(d.groups) for d in (again, found))
    return number > before or (number == before and len(again.groups) < len(found.groups))


def _examined(task, measured, adopted, check, plain=None, before_zeros=None, zeros: bool = True) -> Diagnosis:
    """The diagnosis of recordings without the record-level effects `adopted`; `measured`: the task with them as they came,
    `plain`: a fit of theirs, where it is known; `before_zeros`: task and adopted before zeros of the recordings were; `zeros`:
    whether these may be."""
    first, plain = plain is None, task.fit() if plain is None else plain
    try:
        far = plain.chi2_per_sample > FAR
        suspect = _spoilt(task, plain) if first and far else None
        if suspect is None or not suspect.certain:
            found = _explained(task, measured, adopted, check, plain, before_zeros, zeros)
            if not first or found.verdict != "unknown_at":
                return found
            suspect = suspect if far else _spoilt(task, plain)
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


def _explained(task, measured, adopted, check, plain, before_zeros, zeros) -> Diagnosis:
    """The diagnosis from the plain fit on; arguments as those of `_examined`."""
    if problem := wrong_bench(plain):
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=plain)
    candidates = screened(plain, task.choices)
    if found := hum_on_harmonics(task, adopted, plain, candidates):
        cleaned, hum, freed = found
        return _examined(cleaned, measured, [*adopted, hum], check, freed)
    if found := heat_on_harmonics(task, adopted, plain):
        cleaned, heat, freed = found
        return _examined(cleaned, measured, heat, check, freed)
    plain, candidates, zero, rival = sensor_zero(task, plain, candidates)
    if zeros and zero is None and (found := own_zeros(task, adopted, plain, candidates)):
        cleaned, own, freed = found
        return _examined(cleaned, measured, [*adopted, own], check, freed, (task, adopted))
    free = task.held if zero is None else (*task.held, "sensor.offset")
    checks = check, remove_from_checks(check, [e for e, _ in adopted], task.bench)
    plain, candidates = _screened_finer(task, plain, candidates, free)
    raw = measured.fit(extra=free, choices=plain.choices, refine=False) if adopted else plain
    place = where(plain, candidates, task.recordings, task.bench.output)
    anew = []  # what the diagnosis begins anew with: recordings without what showed beside an effect, or a better plain fit

    def begins_anew(current) -> bool:
        with contextlib.suppress(Late):
            if found := hum_on_harmonics(task.sparing, adopted, current):
                cleaned, hum, _ = found
                anew.append({"task": task.on(recordings=cleaned.recordings), "adopted": [*adopted, hum]})
            elif found := heat_on_harmonics(task.sparing, adopted, current):
                cleaned, heat, _ = found
                anew.append({"task": task.on(recordings=cleaned.recordings), "adopted": heat})
            elif zero is None and (better := _better_valley(task.sparing, plain, candidates, current)):
                anew.append({"task": task, "adopted": adopted, "plain": better, "before_zeros": before_zeros})
        return bool(anew)

    def free_means(fit, best, beside=()) -> bool:
        with contextlib.suppress(Late):
            if zeros and zero is None and (found := unsettled_means(task.sparing, adopted, fit, best, beside)):
                cleaned, own = found
                freed = task.on(recordings=cleaned.recordings)
                anew.append({"task": freed, "adopted": [*adopted, own], "before_zeros": (task, adopted)})
        return bool(anew)

    reached = search(task.timed, plain, worth_a_search(plain, candidates), checks[1], begins_anew, free_means)
    if anew:
        return _examined(measured=measured, check=check, zeros=zeros, **anew[-1])
    needless = False
    with contextlib.suppress(Late):
        needless = before_zeros and needless_zeros(before_zeros[0].sparing, reached)
    if needless:
        return _examined(before_zeros[0], measured, before_zeros[1], check, zeros=False)
    told = None
    with contextlib.suppress(Late):
        told = told_by_checks(task.sparing, reached.current, reached.foretell)
    if told is not None:
        other = None
        with contextlib.suppress(Late):
            other = _plain_there(task.sparing, plain, told) if reached.steps and zero is None else None
        if other is not None:
            remembered = task.on(choices=dataclasses.replace(task.choices, rest=told.choices.rest))
            found = _examined(remembered, measured, adopted, check, other, before_zeros, zeros)
            return found.noted(MEMORY_TEXT.format(STATES[told.choices.rest]))
        plain, raw = (plain, raw) if reached.steps else (told, raw if adopted else told)
        reached = dataclasses.replace(reached, current=told)
    evidence = Evidence(
        reached, tuple(adopted), raw, plain, tuple(candidates), task.recordings, task.bench, checks, _floors(plain), place,
        _absorbed(candidates, reached.tried), task.choices.only,
    )  # fmt: skip
    found = with_zero(_concluded(task, led_by_drifts(evidence)), zero, rival)
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
    """A learned term that serves far better than the effects that were named, in another block, and foretells the check recordings
    no worse, where these leave a misfit, or one that serves as well as `MANY`; None elsewhere."""
    alone = evidence if len(evidence.reached.steps) == 1 else first_alone(evidence)
    named = alone if alone is not None and found.repaired is alone.reached.current else evidence
    steps, current = named.reached.steps, named.reached.current
    if found.verdict not in ("attributed", "group") or not steps:
        return None
    if not found.repaired.chi2_per_sample > LEAVES_MISFIT and len(steps) < MANY:
        return None
    blocks = {t.candidate.block for _, rivals, *_ in steps for t in rivals}
    learned = better_learned(evidence.plain, current, blocks, evidence.recordings, evidence.bench, len(steps), task.progress)
    if learned is None:
        return None
    rows = check_errors(current.actuator, learned.result.actuator, evidence.checks[1], evidence.bench)
    before, after = misfit(rows, "rms_before"), misfit(rows, "rms_after")
    return None if after > WORSE[0] * before + WORSE[1] * len(rows) else learned


def _absorbed(candidates, tried) -> tuple[str, ...]:
    """What these recordings could not show: the density makes nearly all of it, or bends to it beyond what its column tells. What
    scores, or took its share in a fit, did show. `tried`: candidates that were fitted, by name."""
    shown = {name for name, c in tried.items() if (c.achieved_chi2_drop or 0.0) > MIN_DROP}
    silent = [c for c in candidates if abs(c.z) < Z_THRESHOLD and c.name not in shown]
    return tuple(c.name for c in silent if c.visibility < ABSORBED_VISIBILITY or c.name in (*LIKE_DENSITY, *FEEDBACKS))


def _better_valley(task, plain, candidates, current):
    """The plain fit from where that with effects ended, if it falls far: it had settled in a valley of its density, and an effect
    was credited with the way out. Asked where the effects take far more than any promised to first order. None elsewhere.
    """
    drop = chi2_of(plain) - chi2_of(current)
    if drop < UNPROMISED * max(c.z**2 for c in candidates):
        return None
    task.say("the plain model from there", current.chi2_per_sample)
    better = task.fit_on(current, _without_found(current, plain), choices=current.choices)
    return better if chi2_of(better) < chi2_of(plain) - max(MIN_DROP, VALLEY * drop) else None


def _plain_there(task, plain, told):
    """The plain fit from the start memory that check recordings told beside effects, where it leaves less than from its own: then these
    may have made up for that. None elsewhere."""
    task.say("the plain model from that start memory", told.chi2_per_sample)
    other = task.fit_on(plain, _without_found(told, plain), choices=dataclasses.replace(plain.choices, rest=told.choices.rest))
    return other if chi2_of(other) < chi2_of(plain) - MIN_DROP else None


def _without_found(found, plain):
    """The actuator of a fit without the effects that the plain one has not."""
    held = {e.name for e in plain.actuator.effects}
    return functools.reduce(lambda a, e: a if e.name in held else a.without_effect(e.name), found.actuator.effects, found.actuator)


def _screened_finer(task, base, candidates, free):
    """The base and its candidates; where none would take half of what is left, a finer density is given a chance first.

    What a density rougher than its hats leaves scores as effects do (up to 20 on nulls), but on the finest hats (up to 4.3): there
    they are asked for again.
    """
    if base.choices.knots is None or _leader_takes(base, candidates) > HALF:
        return base, candidates
    if base.chi2_per_sample > REFINE_BELOW:
        finer = _on_finer_hats(task, base, free)
        candidates = candidates if finer is base else screened(finer, task.choices)
        base = finer
    last = hats_of_step(base.choices, task.bench, 2)
    rough = last and base.choices.knots != task.choices.knots and FINER_FROM[1] < base.chi2_per_sample < UNEXPLAINED
    if rough and _leader_takes(base, candidates) < HALF:
        finer = task.fit_on(base, base.actuator, extra=free, choices=last[0])
        if finer.chi2_per_sample < REFINE_BELOW and excess_of(finer, 1.0) < FINEST_LEAVE * excess_of(base, 1.0):
            return finer, screened(finer, task.choices)
    return base, candidates


def _on_finer_hats(task, base, free):
    """The fit on a finer density, if one takes its share of what the base leaves."""
    finer, late = base, False
    if base.chi2_per_sample > UNEXPLAINED:  # physics, most likely: unless finer hats take most of it
        for late in (False, True):
            for choices in hats_of_step(base.choices, task.bench, int(late)):
                finer = task.fit_on(base, base.actuator, extra=free, choices=choices)
            if excess_of(finer, 1.0) < COARSE * excess_of(base, 1.0):
                break
        else:
            return base
    finer = task.fit_on(finer, base.actuator, extra=free, choices=finer.choices, refine=UNEXPLAINED)
    last = _on_last_hats(task, finer, free) if finer.chi2_per_sample > UNEXPLAINED else finer
    highest = FINEST_BELOW if excess_of(last, 1.0) < ALL_BUT * excess_of(base, 1.0) else REFINE_BELOW
    if finest(last.choices) and last.chi2_per_sample < highest:
        return last
    if late and finer.chi2_per_sample > REFINE_BELOW:  # so fine a density bends to physics, too
        return base
    return base if finer.choices == base.choices else finer


def _on_last_hats(task, base, free):
    """The fit on finer and finer hats, as long as each takes half of what those before leave."""
    while choices := finer_hats(base.choices):
        finer = task.fit_on(base, base.actuator, extra=free, choices=choices[0])
        if not excess_of(finer, 1.0) < COARSE * excess_of(base, 1.0):
            break
        base = finer
    return base


def _leader_takes(base, candidates) -> float:
    """Of what a fit leaves, the most that an effect promises which no density passes for."""
    best = max((c.z**2 for c in candidates if c.name not in LIKE_DENSITY), default=0.0)
    return best / max(excess_of(base, 1.0), MIN_DROP)


def _floors(result) -> dict:
    """Noise, solver and density, rms in the unit of the reading."""
    noise = result.problem.noise_rms
    above = max(result.chi2_per_sample - 1, 0) / max(np.median([s.samples for s in result.spectra]), 1)
    return {
        "noise_rms": noise,
        "solver_rms": solver_floor(result.problem, result.solution),
        "density_rms": float(noise * np.sqrt(above)),
    }
