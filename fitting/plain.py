"""The plain fit before effects are credited with what it lacks: on a density fine enough, and from where effects or check recordings led."""

import dataclasses
import functools

from .attribute import LIKE_DENSITY, MIN_DROP, chi2_of, excess_of, is_nothing
from .finer import FINER_FROM, FINEST_BELOW, REFINE_BELOW, finer_hats, finest, hats_of_step
from .screen import screened
from .verdict import FAR_FROM_NOISE, HALF, Z_THRESHOLD

UNPROMISED = 3.0  # times what any effect promised, that effects take where the plain fit is tried from where they led
VALLEY = 0.3  # of what they take, that the plain fit must fall by from there
MADE_UP = 0.25  # of what effects take, that another start memory takes without them where they may have made up for that
COARSE = 0.5  # of a misfit, that a finer density may leave where the first one was too coarse
ALL_BUT = 0.05  # share of a misfit that the finest hats may leave to be gone on with up to FINEST_BELOW
FINEST_LEAVE = 0.9  # the same of the finest hats, where those before have taken their share already
UNEXPLAINED = 60.0  # chi2/N below which a finer density is tried where no candidate would take half of the excess


def better_valley(task, plain, candidates, current):
    """The plain fit from where that with effects ended, if it falls far: it had settled in a valley of its density, and an effect
    was credited with the way out. Asked where the effects take far more than any promised to first order, where one of them is
    within its errors of none, and where so little was left that any small change may lead out. None elsewhere.
    """
    drop = chi2_of(plain) - chi2_of(current)
    names = {e.name for e in current.actuator.effects} - {e.name for e in plain.actuator.effects}
    kept = drop < UNPROMISED * max(c.z**2 for c in candidates) and plain.chi2_per_sample > FAR_FROM_NOISE
    if kept and not any(is_nothing(current, n) for n in names):
        return None
    task.say("the plain model from there", current.chi2_per_sample)
    better = task.fit_on(current, _without_found(current, plain), choices=current.choices)
    return better if chi2_of(better) < chi2_of(plain) - max(MIN_DROP, VALLEY * drop) else None


def plain_there(task, plain, told):
    """The plain fit from the start memory that check recordings told beside effects, where it takes a part of what these do: then they
    may have made up for that. None elsewhere."""
    task.say("the plain model from that start memory", told.chi2_per_sample)
    other = task.fit_on(plain, _without_found(told, plain), choices=dataclasses.replace(plain.choices, rest=told.choices.rest))
    least = max(MIN_DROP, MADE_UP * (chi2_of(plain) - chi2_of(told)))
    return other if chi2_of(other) < chi2_of(plain) - least else None


def _without_found(found, plain):
    """The actuator of a fit without the effects that the plain one has not."""
    held = {e.name for e in plain.actuator.effects}
    return functools.reduce(lambda a, e: a if e.name in held else a.without_effect(e.name), found.actuator.effects, found.actuator)


def screened_finer(task, base, candidates, free):
    """The base and its candidates; where none would take half of what is left, a finer density is given a chance first.

    What a density rougher than its hats leaves scores as effects do (up to 20 on nulls), but on the finest hats (up to 4.3): there
    they are asked for again. What next to nothing of a misfit scores may be the hats' too: the next ones are, where they take as much.
    """
    if base.chi2_per_sample < FINER_FROM[0] and (finer := _as_much(task, base, candidates, free)):
        return finer, screened(finer, task.choices)
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


def _as_much(task, base, candidates, free):
    """The fit on the next finer hats, where an effect scores though the noise is all but met and these take what it promises; None elsewhere."""
    promised, hats = _promised(candidates), finer_hats(base.choices)
    if promised < Z_THRESHOLD**2 or not hats or task.bench.drive != "current":
        return None
    finer = task.fit_on(base, base.actuator, extra=free, choices=hats[0])
    return finer if chi2_of(finer) < chi2_of(base) - promised else None


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
    return _promised(candidates) / max(excess_of(base, 1.0), MIN_DROP)


def _promised(candidates) -> float:
    """The most that it promises, as a fall of chi2."""
    return max((c.z**2 for c in candidates if c.name not in LIKE_DENSITY), default=0.0)
