"""What was adopted, once more: an early effect was chosen under the misfit of those that came later.

Effects that these have made needless are dropped, rivals are tried in their place beside all others, and a second mode changes
places with a filter in the sensor. `state`: a `search.Reached`, which each of them changes.
"""

import dataclasses

import numpy as np

from magjax.effects import SensorLag

from .attribute import (
    BIC_DROP,
    COMPANIONS,
    FORM_ERROR,
    MIN_DROP,
    MISFIT,
    MISFIT_TIE,
    WEAK_TIE,
    Trial,
    chi2_of,
    credited,
    excess_of,
    is_nothing,
    is_physical,
    leaders,
    rivals_of,
    taken_beside,
    to_the_end,
)
from .check import check_errors
from .diagnosis import misfit
from .instruments import RINGING, mode_as_filter
from .screen import screened
from .together import SIDE_BY_SIDE, together
from .verdict import HALF, NULL_CHI2

NEAR_RIVAL, MOST_RIVALS = 0.3, 4  # share of what an early effect left, within which rivals are tried beside later ones; how many
NEAR_SHARE = 0.25  # of an early effect's fall, within which too
PROMISED_ANEW = 0.8  # of what an effect has brought beside the others, that another must promise there to be tried


def backward(task, state, made_up=None, last_too: bool = False):
    """Drop an effect adopted early that later ones have made needless: it must still take half of what it leaves open, and where the
    others all but meet the noise more than the form of their laws may leave.
    `made_up`: the candidate of `state.form`, which takes the place of what it has made needless.

    The form error of a right effect looks like another effect until the rest is in place. So is the last one dropped where it
    has come out as nothing: what it seemed to take, the others took when they were fitted once more beside it; `last_too`: or as the
    others are, where these are not those that it was adopted beside.
    """
    for step in state.steps[::-1]:
        name = step[0].name
        actuator = state.current.actuator
        if name not in {e.name for e in actuator.effects}:
            continue
        last = step is state.steps[-1] and not state.form
        if last and (len(state.steps) == 1 or not (last_too or is_nothing(state.current, name))):
            continue
        task.say(f"without {name}", state.current.chi2_per_sample)
        form = FORM_ERROR * (chi2_of(state.steps[0][3]) - chi2_of(state.current))
        most = chi2_of(state.current) + max(MIN_DROP, excess_of(state.current, NULL_CHI2), form)
        trial = task.fit_on(state.current, actuator.without_effect(name), target=most)
        rise = chi2_of(trial) - chi2_of(state.current)
        if rise < max(MIN_DROP, HALF * excess_of(trial, NULL_CHI2), form if trial.chi2_per_sample < MISFIT else 0.0):
            state.current = trial
            if state.form:
                index = state.steps.index(step)
                state.steps[index] = _in_its_place(step, made_up, trial, taken_beside(state.steps, index))
                state.form = None
            else:
                state.steps.remove(step)


def _in_its_place(step, candidate, result, others):
    """The step of an effect that was dropped, with what made up for its form: then the form was not its own. `others`: as of `rivals_of`."""
    _, _, good, previous = step
    effect = result.actuator.effect(candidate.name)
    found = credited(candidate, result, previous, effect, max(excess_of(previous), MIN_DROP))
    trials = [found, *(t for t in good if t.name != candidate.name)]
    return found, rivals_of(found, trials, others=others), trials, previous


def exchange(task, state, check=()) -> bool:
    """Try the rivals of an effect adopted early once more, beside those that came later: they were compared under a misfit
    that was not theirs. Where that changes one, the same goes for the last. Whether any is another now."""
    changed = any([_exchanged(task, state, index, check) for index in range(len(state.steps) - 1)])
    if changed:
        _exchanged(task, state, len(state.steps) - 1)
    return changed


def both_found(steps) -> list:
    """The steps; none has a rival that another has adopted: what was not told apart alone is there beside it."""
    adopted = {step[0].name for step in steps}
    return [(best, [t for t in rivals if t.name == best.name or t.name not in adopted], good, previous) for best, rivals, good, previous in steps]


def _exchanged(task, state, index, check=()) -> bool:
    """The best of an effect adopted and its near rivals, beside all others; whether it is another."""
    best, _, good, previous = state.steps[index]
    behind = max(NEAR_RIVAL * chi2_of(best.result), NEAR_SHARE * best.drop)
    others = {e.name for e in state.current.actuator.effects} - {best.name}
    like = COMPANIONS.get(best.name, ())  # however far they ended alone: as no rivals they were not fitted to their end
    near = [t for t in good if t is not best and t.name not in others and (t.name in like or t.bic_change < best.bic_change + behind)]
    if best.name not in {e.name for e in state.current.actuator.effects}:
        return False
    rest = dataclasses.replace(state.current, actuator=state.current.actuator.without_effect(best.name))
    fresh = _promised_anew(task, state.current, rest, {best.name, *others, *(t.name for t in near)}, check)
    if not near and not fresh:
        return False
    cost = best.parameters * np.log(rest.data_count)
    trials = [Trial(best.candidate, state.current, 0.0, cost, True, best.explained_share, best.parameters)]
    near = sorted(near, key=lambda t: t.bic_change)[:MOST_RIVALS]
    near_enough = (1 + MISFIT_TIE) * chi2_of(state.current) + 2 * WEAK_TIE[1]  # beyond it none is a rival
    trials += _beside(task, rest, near, near_enough)
    wrong = min((t for t in trials if not t.physical), key=lambda t: t.bic_change, default=None)
    trials = [t for t in trials + fresh if t.physical]
    found = min(trials, key=lambda t: t.bic_change)
    state.steps[index] = (found, rivals_of(found, trials, others=taken_beside(state.steps, index)), trials, previous)
    state.current = found.result
    if len(state.steps) == 2 and wrong is not None and wrong.bic_change < found.bic_change - BIC_DROP:
        return _beside_unphysical(task, state, index, wrong) or found.name != best.name
    return found.name != best.name


def _beside(task, rest, rivals, target) -> list[Trial]:
    """Trials of `rivals`, each fitted beside the effects of `rest` alone; the share of the misfit that each takes is that of its own round."""

    def fitted(t):
        return lambda say: to_the_end(task.on(progress=say), rest, t.candidate, MIN_DROP, target)

    ended = together([fitted(t) for t in rivals], task.progress)
    return [dataclasses.replace(trial, explained_share=t.explained_share) for t, trial in zip(rivals, ended, strict=True)]


def _beside_unphysical(task, state, index, wrong) -> bool:
    """Rivals of the other of two effects beside one that would serve better in this place, if that other one were not unphysical there:
    it stood for one of its like. Whether two of them have been adopted."""
    best, _, good, previous = state.steps[index]
    other, _, seconds, before = state.steps[1 - index]
    if not is_physical(wrong.result.actuator.effect(wrong.name)):
        return False
    task.say(f"{wrong.name} in place of {best.name} beside another than {other.name}", state.current.chi2_per_sample)
    rest = dataclasses.replace(wrong.result, actuator=wrong.result.actuator.without_effect(other.name))
    like = COMPANIONS.get(other.name, ())
    seconds = sorted((t for t in seconds if t.name not in (other.name, wrong.name)), key=lambda t: (t.name not in like, t.bic_change))
    tried = [t for t in _beside(task, rest, seconds[:MOST_RIVALS], chi2_of(state.current)) if t.physical]
    if not tried:
        return False
    found = min(tried, key=lambda t: t.bic_change)
    more = (wrong.parameters + found.parameters - best.parameters - other.parameters) * np.log(state.current.data_count)
    if chi2_of(found.result) + more > chi2_of(state.current) - BIC_DROP:
        return False
    own = dataclasses.replace(wrong, result=found.result, physical=True, explained_share=best.explained_share)
    state.steps[index] = (own, [own], [own, *(t for t in good if t.name != own.name)], previous)
    state.steps[1 - index] = (found, rivals_of(found, tried, others=taken_beside(state.steps, 1 - index)), tried, before)
    state.current = found.result
    return True


def _promised_anew(task, current, rest, known, check) -> list[Trial]:
    """Effects that a screening beside the others alone promises to serve as well as the one adopted with them, fitted, where the
    check recordings are missed though the noise is met. `rest`: the current fit without that one; `known`: those tried.

    An effect that imitates two is adopted first, and neither of them need be among its rivals then.
    """
    if not check or current.chi2_per_sample > MISFIT or not missed(current, check, task.bench):
        return []
    task.say("what else goes with the others", current.chi2_per_sample)
    base = task.fit_on(rest, rest.actuator)
    gap = max(chi2_of(base) - chi2_of(current), MIN_DROP)
    candidates = screened(base, task.choices)
    promised = [c for c in leaders(candidates) if c.name not in known and c.z**2 > PROMISED_ANEW * gap][:SIDE_BY_SIDE]
    kin = {name for c in promised for name in COMPANIONS.get(c.name, ())} - known - {c.name for c in promised}
    trials = []
    for c in (*promised, *(c for c in candidates if c.name in kin)):
        result = to_the_end(task, base, c, gap).result
        trials.append(credited(c, result, current, result.actuator.effect(c.name), gap))
    return trials


def missed(result, check, bench) -> bool:
    """Whether check recordings are foretold to worse than 1.4 of their noise, in the mean of the squares."""
    rows = check_errors(result.actuator, result.actuator, check, bench)
    return misfit(rows, "rms_after") > len(rows)


def commuted(task, state, candidate) -> bool:
    """A second mode of the rod may be the rod itself, and what passed for the rod a filter in its sensor: linear filters commute.

    Tried from where the two have changed places, which no fit from the base's optimum reaches. Whether the filter was adopted.
    """
    index = next((k for k, step in enumerate(state.steps) if step[0].name == "second_mode"), None)
    names, held = ("mechanics.f0", "mechanics.xi"), {e.name for e in state.current.actuator.effects}
    if index is None or candidate is None or "second_mode" not in held or "sensor_lag" in held:
        return False
    if set(names) & set(task.bench.priors) or not set(names) <= set(task.bench.free):
        return False
    estimate = state.current.estimate
    modes = [tuple(estimate(n).value for n in names), tuple(estimate(f"effects.second_mode.{n}").value for n in ("f2", "xi2"))]
    rod, sensor = sorted(modes, key=lambda mode: mode[1])
    if sensor[1] < RINGING:
        return False
    task.say("a filter in the sensor in place of a second mode", state.current.chi2_per_sample)
    actuator = state.current.actuator.without_effect("second_mode").replace(dict(zip(names, rod, strict=True)))
    actuator = actuator.with_effect(SensorLag(*mode_as_filter(*sensor)))
    result = task.fit_on(state.current, actuator)
    best, rivals, _, previous = state.steps[index]
    excess = max(excess_of(previous), MIN_DROP)
    own, swapped = (
        credited(c, r, previous, r.actuator.effect(c.name), excess)
        for c, r in ((best.candidate, state.current), (candidate, result))
    )
    found = min((own, swapped), key=lambda t: t.bic_change)
    trials = [own, swapped, *(t for t in rivals if t.name not in ("second_mode", "sensor_lag"))]
    state.steps[index] = (found, rivals_of(found, trials), trials, previous)
    state.current = found.result
    return found is swapped
