"""What the search has found, as the rows of a diagnosis: effects, groups, their sizes, what each candidate achieved."""

import dataclasses

import numpy as np

from magjax.effects import CLASSES

from .attribute import SETTLED_CHI2, UNCONFIRMED_TIE, chi2_of, confidence, rivals_of, taken_beside, tie_of

CREEPS_AFTER = 0.8  # of the drifts, weighed by their recordings' mean readings, that go the way of a creep
DRIFTS = ("zero_drift", "thermal_drift")
SLOW = ("creep", "magnetic_aftereffect")  # effects that go on for longer than a recording
GOES_ON = {"creep": 1.5, "magnetic_aftereffect": 2.0}  # decades of it, times its amplitude, as a share of the mean reading, that a drift of it is less than
PARTIAL = 0.5  # most confidence in an effect of which not all rivals were fitted
BEHIND = 5.0  # decades of a creep, that a mean may lack of its end


def achieved(evidence) -> tuple:
    """The candidates as the screening of the plain fit scored them, with what real fits achieved.

    A trial counts beside the fit that it was tried beside. The one effect that a repair adds counts as it ended.
    """
    steps, current, plain = evidence.reached.steps, evidence.reached.current, evidence.plain
    fitted = evidence.reached.tried | {best.name: best.candidate for best, *_ in steps}
    if len(steps) == 1:
        best, drop = steps[0][0], float(chi2_of(plain) - chi2_of(current))
        bic = float(best.parameters * np.log(plain.data_count) - drop)
        fitted[best.name] = dataclasses.replace(best.candidate, achieved_chi2_drop=drop, bic_change=bic)
    keys = ("achieved_chi2_drop", "bic_change")
    return tuple(
        dataclasses.replace(c, **{k: getattr(fitted[c.name], k) for k in keys}) if c.name in fitted else c
        for c in evidence.candidates
    )


def found_rows(evidence):
    """Effects that stand alone (rows), groups (names), the size that each of their members would have, and the trials of the
    last group."""
    effects, groups, sizes, last = [], [], {}, []
    for effect, rivals in evidence.adopted:
        if creeps_on(effect, evidence) or behind(effect, evidence):
            continue
        same = next((e for e in effects if e["name"] == effect.name), None)
        group = any(effect.name in g for g in groups)
        if same:  # within recordings and between them
            same["parameters"] |= _record_row(effect)["parameters"]
        elif rivals and not group:
            groups.append([effect.name, *[r.name for r in rivals]])
            sizes |= {r.name: _record_row(r)["parameters"] for r in (effect, *rivals)}
        elif not group:
            effects.append(_record_row(effect))
    for best, rivals, good, _ in evidence.reached.steps:
        if len(rivals) > 1:
            groups.append([t.name for t in rivals])
            sizes |= {t.name: sizes_of(t.name, evidence.reached.current if t is best else t.result) for t in rivals}
            last = rivals
        else:
            row = _effect_row(best, good, evidence.raw, evidence.reached.current)
            unsure = evidence.reached.partial and best is evidence.reached.steps[-1][0]
            effects.append({**row, "confidence": min(row["confidence"], PARTIAL)} if unsure else row)
    alone = {e["name"] for e in effects}
    groups = [g for g in groups if not (set(g) <= set(DRIFTS) and set(g) & alone)]  # its means tell a drift from its rival
    return effects, groups, sizes, last


def ties_of(evidence) -> dict:
    """For each member of a group what a fit with it reached, and why it is not told from the best: name -> chi2_per_sample, why."""
    ties = {}
    for effect, rivals in evidence.adopted:
        zeros = effect.shapes.get("zeros")
        why = "both move a recording's mean level as a whole" if zeros else "between the harmonics its score comes near the best's"
        ties |= {r.name: {"chi2_per_sample": None, "why": why if r is not effect else ""} for r in (effect, *rivals) if rivals}
    steps = evidence.reached.steps
    for k, (best, rivals, *_) in enumerate(steps):
        others = taken_beside(steps, k)
        for t in rivals if len(rivals) > 1 else ():
            result = evidence.reached.current if t is best else t.result
            why = "" if t is best else tie_of(best, t, others=others) or tie_of(best, t, UNCONFIRMED_TIE, others)
            ties[t.name] = {"chi2_per_sample": result.chi2_per_sample, "why": why}
    return ties


def creeps_on(effect, evidence) -> str | None:
    """The slow effect that was found, where a drift within the records is that going on: all but a fifth of it to one side of the
    mean displacement, away from where all came from, and less than `GOES_ON` decades of a creep, or than all that is late of M makes of
    its square; None elsewhere."""
    actuator = evidence.reached.current.actuator
    found = {best.name for best, *_ in evidence.reached.steps} & {e.name for e in actuator.effects}
    slow = next((name for name in SLOW if name in found), None)
    if slow is None or effect.name not in DRIFTS or not effect.columns or effect.shapes.get("pulsation"):
        return None
    scale = 1.0 if effect.shapes.get("own") else effect.amplitude
    drifts = scale * np.asarray([column[-1] - column[0] for column in effect.columns])
    means = np.asarray([s.reading[0].real for s in evidence.raw.spectra])
    after = abs(np.sum(drifts * means)) > CREEPS_AFTER * np.sum(np.abs(drifts * means))
    late = actuator.effect(slow)
    most = GOES_ON[slow] * float(getattr(late, late.amplitude))
    return slow if after and np.all(np.abs(drifts) < most * np.abs(means)) else None


def led_by_drifts(evidence):
    """The evidence with a slow effect in place of the last that was found, where it met the noise there, too, the drifts within the
    records are it going on, and they score higher than it was behind: the other one would need a drift beside it."""
    reached = evidence.reached
    drifts = [e for e, _ in evidence.adopted if e.name in DRIFTS and not e.shapes.get("zeros")]
    if not drifts or not reached.steps or any(best.name in SLOW for best, *_ in reached.steps):
        return evidence
    best, _, good, before = reached.steps[-1]
    if reached.current is not best.result:
        return evidence

    def led_by(t, tied=()):
        steps = [*reached.steps[:-1], (t, tied, tied, before)]
        return dataclasses.replace(evidence, reached=dataclasses.replace(reached, current=t.result, steps=steps))

    spoken = max(e.z**2 for e in drifts)
    near = [t for t in good if t.name in SLOW and t.physical and t.result.chi2_per_sample < SETTLED_CHI2]
    slow = [t for t in near if t.bic_change - best.bic_change < spoken and all(creeps_on(e, led_by(t)) for e in drifts)]
    if not slow:
        return evidence
    first = min(slow, key=lambda t: t.bic_change)
    return led_by(first, rivals_of(first, slow))


def behind(effect, evidence) -> str | None:
    """The slow effect that was found, where zeros of the recordings are what each lacks of its end; None elsewhere."""
    actuator = evidence.reached.current.actuator
    found = {best.name for best, *_ in evidence.reached.steps} & {e.name for e in actuator.effects}
    slow = next((name for name in SLOW if name in found), None)
    if slow is None or not effect.shapes.get("zeros"):
        return None
    if slow != "creep":
        return slow
    means = np.asarray([s.reading[0].real for s in evidence.raw.spectra])
    most = BEHIND * float(actuator.effect("creep").gain) * np.sqrt(np.mean(means**2))
    return slow if effect.amplitude < most or _means_left(evidence.reached.current) < most else None


def _means_left(result) -> float:
    """Rms of what a fit leaves of the means, m, but for a common share of them: how far a creep has come in all is not known there.

    The zeros' own size is of first order beside the plain model, and far too large where its density bent to them."""
    problem = result.problem
    made = problem.passes.lines(result.solution.z, problem.predictors[1])[:, 0].real
    left = np.asarray([s.reading[0].real for s in result.spectra]) - made
    left = left - made * (made @ left) / (made @ made)
    return float(np.sqrt(np.mean(left**2)))


def _effect_row(trial, tried, base, final) -> dict:
    """An effect found: its size, and from what to what the constants of the base moved."""
    result = final if any(e.name == trial.name for e in final.actuator.effects) else trial.result
    shifts = {
        e.name: [e.value, result.estimate(e.name).value] for e in base.estimates if e.free and not e.name.startswith("effects.")
    }
    return {
        "name": trial.name, "block": trial.candidate.block, "parameters": sizes_of(trial.name, result),
        "confidence": confidence(trial, tried), "shifts": shifts,
    }  # fmt: skip


def sizes_of(name, result) -> dict:
    """The parameters of an effect as a fit has them, and what was given it, without error; not the details of its law that were held."""
    prefix = f"effects.{name}."
    fitted = {
        e.name[len(prefix) :]: {"value": e.value, "stderr": e.stderr, "unit": e.unit} | ({"at_bound": True} if e.at_bound else {})
        for e in result.estimates
        if e.name.startswith(prefix) and e.free
    }
    given = {n: info.unit for n, info in CLASSES[name].parameters().items() if info.given}
    return fitted | {
        n: {"value": float(getattr(result.actuator.effect(name), n)), "stderr": 0.0, "unit": unit, "given": True}
        for n, unit in given.items()
    }


def _record_row(effect) -> dict:
    kind = CLASSES[effect.name]
    info = kind.parameters()[kind.amplitude]
    size, unit = ("between_recordings", "m") if effect.shapes.get("zeros") else (kind.amplitude, info.unit)
    return {
        "name": effect.name, "block": kind.block,
        "parameters": {size: {"value": effect.amplitude, "stderr": effect.stderr, "unit": unit}},
        "confidence": float(np.clip(1 - np.exp(-abs(effect.z) / 4), 0, 0.99)), "shifts": {},
    }  # fmt: skip
