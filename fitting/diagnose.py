"""diagnose(recordings, bench): where simulation and recordings differ, what physics was left out, and the repaired model.

Order: data first, then the base fit to its floor, record-level effects between the harmonics, the screening of the
catalogue off the full tangent space, real fits of the leaders, groups, checks, the next experiment, the verdict.
"""

import dataclasses

import jax
import numpy as np

from magjax.bench import load_bench
from magjax.effects import CATALOGUE

from .alternation import alternating
from .attribute import (
    BIC_DROP,
    CLOSE,
    MIN_DROP,
    MISFIT,
    SETTLED_CHI2,
    STRUCTURES,
    TIE,
    WEAK_TIE,
    chi2_of,
    confidence,
    family,
    leaders,
    rivals_of,
    try_effect,
)
from .check import check_errors
from .experiments import INSTRUMENTS, instrument_request, next_experiment
from .fit import REFINE_BETWEEN, REST_SETTLED, RESTS_IN_ORDER, fit
from .floors import data_problem, record_effects, remove_from_checks, remove_record_effect, solver_floor, wrong_bench
from .instruments import diagnose_beyond, exchange, known_instruments
from .learned import with_learned_term
from .locate import where
from .placebo import placebo
from .screen import offset_score, screen
from .setup import Choices, spectra_of

SILENT_CHI2 = 1.15  # above it something may be missing even where no single name stands out
Z_THRESHOLD = 5.5  # about forty columns are looked at
RECORD_Z = 8.0
HALF = 0.5  # of the excess over NULL_CHI2 must be taken where the plain fit all but meets the noise
NULL_CHI2 = 0.95
ROUGH_CHI2 = 3.0  # chi2/N that a rough density may leave where nothing scores
FULL_SHARE = 0.96
FAR_FROM_NOISE = 10.0  # chi2/N that no repair may leave and still be called one
MAX_EFFECTS = 3
SECOND_Z = 8.0  # a further effect where the noise is met already: what a rough density leaves scores 6 to 7
ABSORBED_VISIBILITY = 0.004


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The verdict with everything behind it; str() is the message."""

    verdict: str
    message: str
    effects: tuple = ()
    groups: tuple = ()
    absorbed: tuple = ()
    unknown: dict | None = None
    data_problem: str | None = None
    candidates: tuple = ()
    floors: dict = dataclasses.field(default_factory=dict)
    where: dict = dataclasses.field(default_factory=dict)
    check: tuple = ()
    next_experiment: dict | None = None
    base: object = None
    repaired: object = None
    placebo: dict | None = None

    def __str__(self):
        return f"{self.verdict}: {self.message}"

    def as_dict(self) -> dict:
        """The content of diagnosis.json."""
        ranked = [
            {
                "name": c.name, "z": c.z, "visibility": c.visibility, "amplitude": c.amplitude,
                "predicted_chi2_drop": c.predicted_chi2_drop, "achieved_chi2_drop": c.achieved_chi2_drop,
                "bic_change": c.bic_change, "smallest_visible": c.smallest_visible,
            }
            for c in self.candidates
        ]  # fmt: skip
        return {
            "verdict": self.verdict, "effects": list(self.effects), "groups": [list(g) for g in self.groups],
            "absorbed": list(self.absorbed), "unknown": self.unknown, "data_problem": self.data_problem, "candidates": ranked,
            "floors": self.floors, "where": self.where, "check": list(self.check), "next_experiment": self.next_experiment,
            "placebo": self.placebo, "message": self.message, "base": self.base.as_dict() if self.base else None,
            "repaired": self.repaired.as_dict() if self.repaired else None,
        }  # fmt: skip


def diagnose(recordings, bench, *, check=(), calibration=(), actuator=None, choices: Choices = Choices(), progress=None, placebo_runs: int = 0) -> Diagnosis:
    """Diagnose recordings against a bench; `check`: recordings that take no part in any fit.

    Recordings that hold the command beside a measured current, and `calibration`s of the sensor (reference displacement and
    reading), settle those instruments by themselves. `progress` is called as progress(text, step, chi2 per datum).
    `placebo_runs`: fits of recordings that lack nothing, to see how often the search would cry wolf. Returns a `Diagnosis`;
    raises `RecordingError` where a recording cannot be used at all.
    """
    bench = load_bench(bench)
    say = progress or (lambda *a: None)
    recordings, check = list(recordings), list(check)
    if known := known_instruments(recordings, calibration, bench):
        return diagnose_beyond(known, diagnose, recordings, bench, check, actuator, choices, progress)
    held = tuple(f"effects.{e.name}.{p}" for e in (actuator.effects if actuator is not None else ()) for p in e.parameters())
    spectra = spectra_of(recordings, bench, choices.harmonics)
    say("between the harmonics", 0, None)
    if alternation := alternating(recordings, spectra, bench.output):
        rest = diagnose(alternation.cleaned, bench, check=check, actuator=actuator, choices=choices, progress=progress, placebo_runs=placebo_runs)
        return alternation.told(rest)
    problem = data_problem(recordings, spectra, bench.output)
    if problem:
        base = fit(recordings, bench, actuator=actuator, extra=held, choices=choices, progress=progress, refine=False)
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=base)
    adopted, cleaned = _record_level(recordings, spectra, bench, choices)
    base_now = fit(cleaned, bench, actuator=actuator, extra=held, choices=choices, progress=progress)
    if problem := wrong_bench(base_now):
        return Diagnosis("data_problem", problem + ".", data_problem=problem, base=base_now)
    base_now, zero = _sensor_zero(cleaned, bench, base_now, actuator, held, choices, progress)
    base = base_now
    if adopted:  # what the plain model makes of the readings as they came
        free = held if zero is None else (*held, "sensor.offset")
        base = fit(recordings, bench, actuator=actuator, extra=free, choices=base_now.choices, progress=progress, refine=False)
    recordings = cleaned
    cleaned_check = remove_from_checks(check, [e for e, _ in adopted], bench)
    candidates = _screen(base_now, choices)
    noise = base_now.problem.noise_rms
    floors = {
        "noise_rms": noise,
        "solver_rms": solver_floor(base_now.problem, base_now.solution),
        "density_rms": float(noise * np.sqrt(max(base_now.chi2_per_sample - 1, 0) / max(np.median([s.samples for s in base.spectra]), 1))),
    }
    place = where(base_now, candidates, recordings, bench.output)
    absorbed = tuple(c.name for c in candidates if c.visibility < ABSORBED_VISIBILITY)
    state = _search(recordings, bench, base_now, candidates, choices, progress, cleaned_check)
    common = {"floors": floors, "where": place, "absorbed": absorbed, "base": base}
    checks = (check, cleaned_check)
    found = _verdict(state, adopted, base, base_now, candidates, recordings, bench, checks, common)
    if found.verdict == "unknown_at":
        found = with_learned_term(found, base_now, recordings, bench, cleaned_check, progress)
        silent = not state.steps and state.current.chi2_per_sample < ROUGH_CHI2 and abs(candidates[0].z if candidates else 0.0) < Z_THRESHOLD
        if silent and "function" not in found.unknown:  # nor does a smooth function of the signals: no place can be told
            found = _verdict(state, adopted, base, base_now, candidates, recordings, bench, checks, common, rough=True)
    if placebo_runs > 0:
        found = dataclasses.replace(found, placebo=placebo(state.current, Z_THRESHOLD, placebo_runs, without=choices.without, progress=progress))
    if zero is None:
        return found
    note = f" The sensor's zero is {zero:.3g} m away from the rod's rest; free sensor.offset in the bench file."
    return dataclasses.replace(found, message=found.message + note)


def _screen(result, choices) -> list:
    """Every effect that may be asked for, best first."""
    return [c for c in screen(result.problem, result.refined) if c.name not in choices.without]


def _sensor_zero(recordings, bench, base, actuator, held, choices, progress):
    """A sensor whose zero is not the rod's rest: adopted as part of the base only if that alone meets the noise."""
    if bench.output != "displacement" or base.chi2_per_sample < 3 or "sensor.offset" in bench.free:
        return base, None
    if offset_score(base.problem, base.refined) ** 2 < 0.5 * (chi2_of(base) - base.data_count):  # it cannot explain the misfit
        return base, None
    freed = fit(recordings, bench, actuator=actuator, extra=(*held, "sensor.offset"), choices=choices, progress=progress)
    if freed.chi2_per_sample > SILENT_CHI2:
        return base, None
    return freed, freed.estimate("sensor.offset").value


def _record_level(recordings, spectra, bench, choices):
    """Drift, heat and hum, scored between the harmonics: (adopted with their rivals, the recordings without them)."""
    adopted = []
    for _ in range(0 if bench.columns.get("time", {}).get("quasistatic") or bench.output != "displacement" else 2):
        found = [e for e in record_effects(recordings, spectra) if e.name not in {a.name for a, _ in adopted}]
        best = found[0]
        if abs(best.z) < RECORD_Z:
            break
        rivals = [e for e in found[1:] if abs(e.z) > 0.9 * abs(best.z)]
        adopted.append((best, rivals))
        recordings = remove_record_effect(recordings, best, bench.output)
        spectra = spectra_of(recordings, bench, choices.harmonics)
    return adopted, recordings


@dataclasses.dataclass
class _State:
    """What the search has reached: the current fit, adopted trials with their rivals, all trials of the last round."""

    current: object
    steps: list
    tried: dict
    excess: float
    unexplained: float


def _search(recordings, bench, base, candidates, choices, progress, check=()) -> _State:
    """Forward: fit the leaders from scratch, adopt the best while it earns its place; then screen again."""
    say = progress or (lambda *a: None)
    classes = {c.name: c for c in CATALOGUE}
    count = base.data_count
    floor = min(1.0, base.chi2_per_sample) * count
    state = _State(base, [], {}, max(chi2_of(base) - floor, 0.0), max(chi2_of(base) - floor, 0.0))
    chosen = base.choices  # the density chosen for the base may be finer than the default: rivals get the same
    for _round in range(MAX_EFFECTS):
        top = leaders(candidates)
        calm = state.steps and state.current.chi2_per_sample < SILENT_CHI2
        if not top or abs(top[0].z) < (SECOND_Z if calm else Z_THRESHOLD):
            break
        excess = max(chi2_of(state.current) - 0.92 * count, MIN_DROP)
        trials = []

        def attempt(c, trials=trials, excess=excess, chosen=chosen):
            say(f"trying {c.name}", 0, state.current.chi2_per_sample)
            reached = min((chi2_of(t.result) for t in trials if t.physical), default=np.inf) + 2 * WEAK_TIE[1]
            trial = try_effect(recordings, bench, state.current, c, classes[c.name], chosen, excess, progress, bool(state.steps), reached)
            trials.append(trial)
            state.tried[c.name] = trial.candidate

        for c in top:
            settled = [t for t in trials if t.physical and t.result.chi2_per_sample < SETTLED_CHI2]
            if settled and c.name not in STRUCTURES and abs(c.z) < CLOSE * abs(settled[0].candidate.z):
                continue
            attempt(c)
        first = min((t for t in trials if t.physical), key=lambda t: t.bic_change, default=None)
        for c in family(first.candidate, candidates, {t.name for t in trials}) if first else ():
            attempt(c)
        good = [t for t in trials if t.physical and t.drop > MIN_DROP and t.bic_change < -BIC_DROP]
        if not good:
            break
        best = min(good, key=lambda t: t.bic_change + (0 if t.result.converged else 5))
        if state.steps and best.drop < 0.5 * excess and chi2_of(state.current) / count > 1.3 and best.drop < 0.3 * excess:
            break
        if state.steps and check and _predicts_worse(state.current.actuator, best.result.actuator, check, bench):
            break
        best, good, chosen = _finer(recordings, bench, state.current, best, good, chosen, excess, progress, choices.rest == "auto")
        state.steps.append((best, rivals_of(best, good), good, state.current))
        state.current = best.result
        candidates = _screen(best.result, choices)
        jax.clear_caches()  # programs of trials that are not needed again
    _backward(recordings, bench, state, chosen, count, progress)
    state.unexplained = max(chi2_of(state.current) - count, 0.0)
    return state


def _predicts_worse(before, after, check, bench) -> bool:
    """Does a further effect raise the error on check recordings, taken together in units of their noise?"""
    rows = check_errors(before, after, check, bench)
    old, new = (sum((r[k] / (r["noise_rms"] or r["rms_before"])) ** 2 for r in rows) for k in ("rms_before", "rms_after"))
    return new > 1.02 * old


def _backward(recordings, bench, state, chosen, count, progress):
    """Drop an effect adopted early that later ones have made needless: it must still take half of what it leaves open.

    The form error of a right effect looks like another effect until the rest is in place.
    """
    say = progress or (lambda *a: None)
    for step in state.steps[:-1][::-1]:
        name = step[0].name
        actuator = state.current.actuator
        if name not in {e.name for e in actuator.effects}:
            continue
        say(f"without {name}", 0, state.current.chi2_per_sample)
        fewer = actuator.without_effect(name)
        held = tuple(f"effects.{e.name}.{p}" for e in fewer.effects for p in e.parameters())
        trial = fit(recordings, bench, actuator=fewer, extra=held, choices=chosen, refine=False, progress=progress)
        rise = chi2_of(trial) - chi2_of(state.current)
        if rise < max(MIN_DROP, 0.5 * (chi2_of(trial) - 0.95 * count)):
            state.steps.remove(step)
            state.current = trial


def _finer(recordings, bench, current, best, good, chosen, excess, progress, any_rest: bool = True):
    """The best with another start memory and with a finer density where it still leaves something: both were chosen under
    the misfit of the base. Where that changes them, the near rivals are tried again on the same.

    Start memories that serve as well foretell other mean levels: the one that is tried first stands unless another is
    better by MIN_DROP.
    """
    names = tuple(e.name for e in best.result.estimates if e.name.startswith("effects."))
    found = chosen
    later = chosen.rest != RESTS_IN_ORDER[0]
    if any_rest and bench.start == "auto" and (later or best.result.chi2_per_sample > REST_SETTLED):
        free = dataclasses.replace(chosen, rest="auto")
        other = fit(recordings, bench, actuator=best.result.actuator, extra=names, choices=free, refine=False, progress=progress)
        margin = MIN_DROP if RESTS_IN_ORDER.index(other.choices.rest) < RESTS_IN_ORDER.index(chosen.rest) else -MIN_DROP
        if chi2_of(other) < chi2_of(best.result) + margin:
            found = other.choices
    if chosen.knots is not None and REFINE_BETWEEN[0] < best.result.chi2_per_sample < REFINE_BETWEEN[1]:
        found = fit(recordings, bench, actuator=best.result.actuator, extra=names, choices=found, refine=True, progress=progress).choices
    if found == chosen:
        return best, good, chosen
    classes = {c.name: c for c in CATALOGUE}
    near = [t for t in good if chi2_of(t.result) < chi2_of(best.result) + max(20 * TIE, 0.2 * chi2_of(best.result))]
    again = [try_effect(recordings, bench, current, t.candidate, classes[t.name], found, excess, progress) for t in near]
    again = [t for t in again if t.physical] or [best]
    return min(again, key=lambda t: t.bic_change), again, found


def _verdict(state, adopted, base, base_now, candidates, recordings, bench, checks, common, rough: bool = False) -> Diagnosis:
    """`checks`: the check recordings as they came, and without the record-level signals; `rough`: what is left has been
    looked for and is put down to the density."""
    ranked = tuple(state.tried.get(c.name, c) for c in candidates)
    dropped = _too_little(state, base_now)
    if dropped:
        state = dataclasses.replace(state, current=base_now, steps=[])
    before = base.actuator
    after = state.current.actuator
    rows = tuple(check_errors(before, after, checks[0], bench, checks[1])) if checks[0] else ()
    excess = state.current.chi2_per_sample
    effects, groups = [], []
    for effect, rivals in adopted:
        if rivals:
            groups.append([effect.name, *[r.name for r in rivals]])
        else:
            effects.append(_record_row(effect))
    last_rivals = []
    for best, rivals, good, previous in state.steps:
        if len(rivals) > 1:
            groups.append([t.name for t in rivals])
            last_rivals = rivals
        else:
            effects.append(_effect_row(best, good, previous, state.current))
    repaired = state.current if state.steps or adopted else None
    common = {**common, "candidates": ranked, "check": rows, "repaired": repaired}
    count = base_now.data_count
    missing = excess > SILENT_CHI2 + 3 * np.sqrt(2 / count)
    share = 1 - max(excess - 1, 0) / max(base_now.chi2_per_sample - 1, 1e-9) if base_now.chi2_per_sample > SILENT_CHI2 else 1.0
    if missing and not rough and (not state.steps or share < FULL_SHARE or excess > FAR_FROM_NOISE):
        return _unknown(state, share, excess, common)
    worse = [r for r in rows if r["rms_after"] > 1.05 * r["rms_before"] and r["rms_after"] > 1.3 * r["noise_rms"]]
    if state.steps and rows and len(worse) == len(rows):  # a repair that predicts nothing better is not physics
        return _unknown(state, share, excess, common, " The repair that fits best predicts every check recording worse, so it is not named.")
    if not effects and not groups:
        text = f"nothing is missing: chi2/N = {excess:.2f} and "
        if dropped:
            text += f"{dropped}, which serves best, takes less than half of what is above the noise."
        else:
            text += f"no effect of the catalogue scores above {Z_THRESHOLD} (highest: "
            text += f"{candidates[0].name}, z = {candidates[0].z:.1f})." if candidates else "none)."
        if rough:
            text += " What is left above the noise follows no smooth function of the signals either: a density rougher than the fit's, most likely."
        if common["absorbed"]:
            text += f" These recordings could not show {', '.join(common['absorbed'])}: the density absorbs them."
        return Diagnosis("nothing_missing", text, **common)
    better = "; ".join(f"{r['file'].rsplit('/', 1)[-1]}: {r['rms_before']:.3g} -> {r['rms_after']:.3g} {r['unit']}" for r in rows)
    swap, asked = exchange(state.current, bench), None
    measured = all(r.origin.get("metadata", {}).get("current") == "measured" for r in recordings)
    if swap:
        asked = instrument_request({"sensor"} if measured else {"source", "sensor"})
        if swap[1] and not any("sensor_lag" in g for g in groups):
            effects = [e for e in effects if e["name"] != "sensor_lag"]
            groups.append(["sensor_lag", "second_mode"])
    if groups:
        blocks = {t.candidate.block for t in last_rivals}
        between = bool(blocks & set(INSTRUMENTS)) and not blocks <= set(INSTRUMENTS)
        also = INSTRUMENTS if between and excess > MISFIT and not measured and bench.drive == "current" else ()  # more than one is amiss
        experiment = asked or (next_experiment(last_rivals, base.spectra, bench, also) if last_rivals else None)
        names = "; ".join(" or ".join(g) for g in groups)
        text = f"something is missing that these recordings cannot tell apart: {names}."
        if effects:
            text += f" Found beside it: {', '.join(e['name'] for e in effects)}."
        text += " Instruments and actuator are not told apart by these channels." if between and not swap else ""
        text += f" {swap[0]}" if swap else ""
        text += f" chi2/N falls from {base.chi2_per_sample:.3g} to {excess:.2f}." if swap else ""
        if experiment:
            text += f" Next: {experiment['text']}."
        return Diagnosis("group", text, tuple(effects), tuple(groups), next_experiment=experiment, **common)
    named = " and ".join(f"{e['name']} ({e['block']})" for e in effects)
    text = f"{named} {'was' if len(effects) == 1 else 'were'} left out: chi2/N falls from {base.chi2_per_sample:.3g} to {excess:.2f}."
    text += f" On check recordings: {better}." if better else " Record a check at another frequency to confirm it."
    if swap:
        text += f" {swap[0]} To tell: {asked['text']}."
    return Diagnosis("attributed", text, tuple(effects), next_experiment=asked, **common)


def _too_little(state, base) -> str | None:
    """The names of effects that all but meet the noise but take less than half of what the plain fit leaves above it: what a rough
    density leaves looks like a weak effect, but no effect takes it up."""
    least = SILENT_CHI2 + 3 * np.sqrt(2 / base.data_count)
    if not state.steps or not state.current.chi2_per_sample < least:
        return None
    taken = base.chi2_per_sample - state.current.chi2_per_sample
    if taken > HALF * (base.chi2_per_sample - NULL_CHI2):
        return None
    return " and ".join(best.name for best, *_ in state.steps)


def _unknown(state, share, excess, common, note: str = "") -> Diagnosis:
    blocks = common["where"]["by_block"]
    block = max(blocks, key=blocks.get) if blocks else "hysteresis"
    fields = common["where"]["by_field"]
    region = f"field quarter {int(np.argmax(fields)) + 1} of 4" if fields else ""
    best = state.steps[0][0].name if state.steps else (common["candidates"][0].name if common["candidates"] else "none")
    text = (
        f"something is missing that no effect of the catalogue explains (chi2/N = {excess:.3g} at best; {best} comes nearest and explains "
        f"{max(share, 0):.0%} of the excess). It acts most like the block {block}, in {region}."
    )
    unknown = {"block": block, "region": region, "explained_share": float(np.clip(share, 0, 1))}
    return Diagnosis("unknown_at", text + note, unknown=unknown, **common)


def _effect_row(trial, tried, previous, final) -> dict:
    result = final if any(e.name == trial.name for e in final.actuator.effects) else trial.result
    prefix = f"effects.{trial.name}."
    parameters = {
        e.name[len(prefix) :]: {"value": e.value, "stderr": e.stderr, "unit": e.unit} for e in result.estimates if e.name.startswith(prefix)
    }
    shifts = {}
    for e in previous.estimates:
        if e.free and not e.name.startswith("effects."):
            shifts[e.name] = [e.value, result.estimate(e.name).value]
    return {
        "name": trial.name, "block": trial.candidate.block, "parameters": parameters,
        "confidence": confidence(trial, tried), "shifts": shifts,
    }  # fmt: skip


def _record_row(effect) -> dict:
    classes = {c.name: c for c in CATALOGUE}
    kind = classes[effect.name]
    info = kind.parameters()[kind.amplitude]
    return {
        "name": effect.name, "block": kind.block,
        "parameters": {kind.amplitude: {"value": effect.amplitude, "stderr": effect.stderr, "unit": info.unit}},
        "confidence": float(np.clip(1 - np.exp(-abs(effect.z) / 4), 0, 0.99)), "shifts": {},
    }  # fmt: skip
