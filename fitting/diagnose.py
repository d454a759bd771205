"""diagnose(recordings, bench): where simulation and recordings differ, what physics was left out, and the repaired model.

Order: data first, then the base fit to its floor, record-level effects between the harmonics, the screening of the
catalogue off the full tangent space, real fits of the leaders, groups, checks, the next experiment, the verdict.
"""

import dataclasses

import numpy as np

from magjax.bench import load_bench

from .alternation import alternating
from .attribute import MIN_DROP, TIE, WEAK_TIE, chi2_of
from .fit import FINER_FROM, REFINE_BELOW
from .fit import fit_or_stop as fit
from .floors import data_problem, solver_floor, wrong_bench
from .instruments import diagnose_beyond, known_instruments
from .learned import with_learned_term
from .locate import where
from .on_lines import hum_score, offset_score
from .record_level import hum_of, record_effects, remove_from_checks, remove_record_effect
from .search import SECOND_Z, screened, search
from .setup import Choices, effect_parameters, spectra_of, with_held_masses
from .verdict import FULL_SHARE, ROUGH_CHI2, SILENT_CHI2, Z_THRESHOLD, Diagnosis, Evidence, misfit, too_little, verdict

RECORD_Z = 8.0
FAR_ZERO = 3.0  # chi2/N from which a sensor's zero need not score highest: far from the first order others do
MOST_OF_IT = 0.8  # of a misfit, that hum on harmonics must take
ABSORBED_VISIBILITY = 0.004
LIKE_DENSITY = ("mean_field", "reversible_magnetization")  # of their kin: the density bends to them further than its tangent tells
FORETOLD = 0.3  # of the check recordings' misfit that a repair may leave: of their sum, and of the middle one
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
) -> Diagnosis:
    """Diagnose recordings against a bench; `check`: recordings that take no part in any fit.

    Recordings that hold the command beside a measured current, and `calibration`s of the sensor (reference displacement and
    reading), settle those instruments by themselves. `progress` is called as progress(text, step, chi2 per datum).
    Returns a `Diagnosis`; raises `RecordingError` where a recording cannot be used at all.
    """
    bench = load_bench(bench)
    say = progress or (lambda *a: None)
    recordings, check = list(recordings), list(check)
    choices = with_held_masses(choices, bench, actuator)
    if known := known_instruments(recordings, calibration, bench):
        return diagnose_beyond(known, diagnose, recordings, bench, check, actuator, choices, progress)
    spectra = spectra_of(recordings, bench, choices.harmonics)
    say("between the harmonics", 0, None)
    if alternation := alternating(recordings, spectra, bench.output):
        asked = {"check": check, "actuator": actuator, "choices": choices, "progress": progress}
        return alternation.told(diagnose(alternation.cleaned, bench, **asked))
    held = effect_parameters(actuator)
    if problem := data_problem(recordings, spectra, bench.output):
        base = fit(recordings, bench, actuator=actuator, extra=held, choices=choices, progress=progress, refine=False)
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=base)
    adopted, cleaned = _record_level(recordings, spectra, bench, choices)
    return _examined(recordings, cleaned, adopted, bench, check, actuator, held, choices, progress)


def _examined(recordings, cleaned, adopted, bench, check, actuator, held, choices, progress, plain=None) -> Diagnosis:
    """The diagnosis of recordings `cleaned` of the record-level effects `adopted`; `plain`: their fit, where it is known."""
    if plain is None:
        plain = fit(cleaned, bench, actuator=actuator, extra=held, choices=choices, progress=progress)
    if problem := wrong_bench(plain):
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=plain)
    candidates = screened(plain, choices)
    asked = bench, check, actuator, held, choices, progress
    hummed = {"actuator": actuator, "extra": held, "choices": choices, "progress": progress}
    if found := _hum_on_harmonics(cleaned, adopted, bench, plain, candidates, hummed):
        return _examined(recordings, found[0], [*adopted, found[1]], *asked, plain=found[2])
    plain, candidates, zero, rival = _sensor_zero(cleaned, bench, plain, candidates, actuator, held, choices, progress)
    raw, free = plain, held if zero is None else (*held, "sensor.offset")
    if adopted:  # what the plain model makes of the readings as they came
        raw = fit(recordings, bench, actuator=actuator, extra=free, choices=plain.choices, progress=progress, refine=False)
    checks = check, remove_from_checks(check, [e for e, _ in adopted], bench)
    plain, candidates = _screened_finer(cleaned, bench, plain, candidates, choices, free, progress)
    place = where(plain, candidates, cleaned, bench.output)
    reached = search(cleaned, bench, plain, candidates, choices, progress, checks[1])
    if reached.steps and (found := _hum_on_harmonics(cleaned, adopted, bench, reached.current, (), hummed)):
        return _examined(recordings, found[0], [*adopted, found[1]], *asked)
    evidence = Evidence(
        reached, tuple(adopted), raw, plain, tuple(candidates), tuple(cleaned), bench, checks, _floors(plain), place, _absorbed(candidates, reached.tried)
    )  # fmt: skip
    return _with_zero(_concluded(evidence, progress), zero, rival)


def _concluded(evidence, progress) -> Diagnosis:
    """The verdict; where no effect explains the misfit, a rough density's or with a function learned in its place."""
    found = verdict(evidence)
    if found.verdict != "unknown_at":
        return found
    if _rough(evidence, found.check):
        return verdict(evidence, rough=True)
    return with_learned_term(found, evidence.plain, evidence.recordings, evidence.bench, evidence.checks[1], progress)


def _with_zero(found, zero, rival) -> Diagnosis:
    """The diagnosis with a word on the sensor's zero: adopted, or told of beside an effect that does as well."""
    if zero is not None:
        note = f" The sensor's zero is {zero:.3g} m away from the rod's rest; free sensor.offset in the bench file."
    elif rival is not None and (found.effects or found.groups):
        note = f" A sensor's zero {rival:.3g} m away from the rod's rest would explain as much; if it was not set there, free sensor.offset in the bench file."
    else:
        return found
    return dataclasses.replace(found, message=found.message + note)


def _absorbed(candidates, tried) -> tuple[str, ...]:
    """What these recordings could not show: the density makes nearly all of it. What scores or was fitted did show."""
    silent = [c for c in candidates if abs(c.z) < Z_THRESHOLD and c.name not in tried]
    return tuple(c.name for c in silent if c.visibility < ABSORBED_VISIBILITY or c.name in LIKE_DENSITY)


def _hum_on_harmonics(recordings, adopted, bench, base, candidates, asked):
    """Hum that falls on harmonics of the drive, where no repeat shows it: adopted if it scores above every effect and takes
    most of what `base` leaves. Returns the recordings without it, the effect with its rivals, and their fit; None elsewhere.
    """
    held = any(e.name == "mains_hum" for e, _ in adopted)
    if held or bench.output != "displacement" or _quasistatic(bench) or not base.chi2_per_sample > SILENT_CHI2:
        return None
    excess = chi2_of(base) - 0.92 * base.data_count
    z, tones = hum_score(base.problem, base.refined)
    if z**2 < max([Z_THRESHOLD**2, 0.5 * excess, *(c.z**2 for c in candidates)]):
        return None
    effect = hum_of(base.spectra, z, tones)
    cleaned = remove_record_effect(recordings, effect, bench.output)
    more = {"actuator": base.actuator, "extra": effect_parameters(base.actuator)}
    freed = fit(cleaned, bench, **{**asked, **more})
    if chi2_of(freed) > chi2_of(base) - MOST_OF_IT * excess:
        return None
    return cleaned, (effect, []), freed


def _sensor_zero(recordings, bench, base, candidates, actuator, held, choices, progress):
    """A sensor whose zero is not the rod's rest: part of the base, if it scores above any effect and alone meets the noise.

    Returns the base, its candidates, the zero, m, or None, and the zero that would explain as much as the best effect, or None.
    """
    as_it_is = base, candidates, None, None
    if bench.output != "displacement" or bench.drive == "voltage" or "sensor.offset" in bench.free:
        return as_it_is
    best, excess = max((c.z**2 for c in candidates), default=0.0), chi2_of(base) - 0.92 * base.data_count
    score = offset_score(base.problem, base.refined) ** 2
    tied = max(TIE, WEAK_TIE[0] * best)
    needed = min(best - tied, 0.5 * excess) if base.chi2_per_sample > FAR_ZERO else best - tied
    if score < max(Z_THRESHOLD**2, needed):
        return as_it_is
    asked = {"actuator": actuator, "extra": (*held, "sensor.offset"), "progress": progress, "spectra": base.spectra}
    freed = fit(recordings, bench, choices=base.choices, start=base, refine=False, **asked)
    if chi2_of(freed) > chi2_of(base) - max(0.5 * excess, MIN_DROP):
        return as_it_is
    if freed.chi2_per_sample > FINER_FROM[0]:  # the density was chosen under the misfit
        freed = fit(recordings, bench, choices=choices, **asked)
    if freed.chi2_per_sample > SILENT_CHI2:
        return as_it_is
    zero = freed.estimate("sensor.offset").value
    if score < best + tied and base.chi2_per_sample < FAR_ZERO:
        return base, candidates, None, zero
    return freed, screened(freed, choices), zero, None


def _screened_finer(recordings, bench, base, candidates, choices, held, progress):
    """The base and its candidates; where none would take half of what is left, a finer density is given a chance first."""
    best = max((c.z**2 for c in candidates), default=0.0)
    meant = REFINE_BELOW <= base.chi2_per_sample < UNEXPLAINED and base.choices.knots is not None
    if not meant or best > 0.5 * (chi2_of(base) - base.data_count):
        return base, candidates
    finer = fit(
        recordings, bench, actuator=base.actuator, extra=held, choices=base.choices, start=base, refine=UNEXPLAINED, progress=progress,
        spectra=base.spectra,
    )  # fmt: skip
    return (base, candidates) if finer.choices == base.choices else (finer, screened(finer, choices))


def _quasistatic(bench) -> bool:
    return bool(bench.columns.get("time", {}).get("quasistatic"))


def _record_level(recordings, spectra, bench, choices):
    """Drift, heat and hum, scored between the harmonics: (adopted with their rivals, the recordings without them)."""
    adopted = []
    for _ in range(0 if _quasistatic(bench) or bench.output != "displacement" else 2):
        known = {a.name for a, _ in adopted} | ({"thermal_drift"} if bench.drive == "voltage" else set())  # the heat of a coil
        found = [e for e in record_effects(recordings, spectra) if e.name not in known]
        best = found[0]
        if abs(best.z) < RECORD_Z:
            break
        rivals = [e for e in found[1:] if abs(e.z) > 0.9 * abs(best.z)]
        adopted.append((best, rivals))
        recordings = remove_record_effect(recordings, best, bench.output)
        spectra = spectra_of(recordings, bench, choices.harmonics)
    return adopted, recordings


def _floors(result) -> dict:
    """Noise, solver and density, rms in the unit of the reading."""
    noise = result.problem.noise_rms
    above = max(result.chi2_per_sample - 1, 0) / max(np.median([s.samples for s in result.spectra]), 1)
    return {
        "noise_rms": noise,
        "solver_rms": solver_floor(result.problem, result.solution),
        "density_rms": float(noise * np.sqrt(above)),
    }


def _rough(evidence, checks) -> bool:
    """Whether what is left is the density's: little, and nothing scores beyond what a rough one leaves and nothing earned its
    place; or a finer density was asked for and what is named foretells the check recordings, which took no part
    (without any, it must explain all but a little).

    A smooth function could always be learned from it, and would be no physics.
    """
    if not evidence.excess < ROUGH_CHI2:
        return False
    steps, current = evidence.reached.steps, evidence.reached.current
    if not steps:
        return max((abs(c.z) for c in evidence.candidates), default=0.0) < SECOND_Z
    if too_little(evidence.reached, evidence.plain):
        return True
    finer = current.choices.knots is not None and current.choices.knots[0] > Choices().knots[0]
    if not checks:
        return finer and evidence.share > FULL_SHARE
    before, after = ([misfit([row], which) for row in checks] for which in ("rms_before", "rms_after"))
    left = [a / b for a, b in zip(after, before, strict=True) if b > 1]  # of those that leave something to foretell
    return finer and sum(before) > len(checks) and sum(after) < FORETOLD * sum(before) and bool(np.median(left) < FORETOLD)
