"""What a round of the search has chosen, before it is adopted: whether two serve better, and on which density and memory."""

import dataclasses
import functools

import numpy as np

from .attribute import (
    BIC_DROP,
    FORM_ERROR,
    LIKE_DENSITY,
    MIN_DROP,
    MISFIT,
    TIE,
    chi2_of,
    credited,
    excess_of,
    of_one_family,
    settled,
    to_the_end,
)  # fmt: skip
from .finer import FINER_FROM, REFINE_BESIDE, finer_hats, hats_of_step, on
from .memories import REST_SETTLED, against_memory, memory_is_told, rests_of
from .screen import screened
from .setup import Choices
from .together import together
from .trials import IMITATES
from .verdict import FAR_FROM_NOISE, HALF

LITTLE_LEFT = 0.2  # share of a chi2/N that an effect may leave for a finer density to be tried beside it, however far that is
FAR_BESIDE = 2.0  # chi2/N beside an effect from which a further one is asked for before a finer density
LEADS_WITHIN, RIVALS_OF_TWO, SAME = 5.0, 3, 1e-3  # of the best's chi2, how many, and how far apart in theirs,
SAME_OF_KIN = 0.03  # those of one family
PAIRS_END = 2.0  # times the chi2/N that they must meet, at which they end early: what a step promises is less than what details bring
AS_HIGH, AHEAD = 0.9, 4  # share of the highest score beside a rival, from which effects are tried with it, and how many


def promises(base, result, candidates) -> bool:
    """Whether a further effect promises more than half of a misfit, and more than the form of those found leaves: then the
    density waits, for a finer one would take it up. It does not wait for what a rough one passes for."""
    least = max(HALF * excess_of(result), FORM_ERROR * (chi2_of(base) - chi2_of(result)))
    promised = max((c.z**2 for c in candidates if c.name not in LIKE_DENSITY), default=0.0)
    return result.chi2_per_sample > FAR_BESIDE and promised > least


def of_two(task, best, left, good, with_others=None, means=lambda fit, scores: False):
    """The best and the scores beside it; or a rival's, with which a further effect explains what the best leaves; `with_others`: the
    fit of the best with what was found beside it, if any was; `means(fit, scores)`: whether beside a rival means of the recordings serve
    as that further one, which ends it: (None, scores).

    One effect with shapes of its own imitates two others better than either of them alone; and where none takes most, the
    first to be found is seldom one of the two. Rivals of other directions are looked ahead from by their scores.
    """
    standing = best.result if with_others is None else with_others
    if standing.chi2_per_sample < MISFIT:
        return best, left
    tried, ahead = [best], []
    near = MISFIT if best.explained_share > IMITATES and with_others is None else FAR_FROM_NOISE
    for rival in sorted((t for t in good if t is not best), key=lambda t: chi2_of(t.result)):
        if chi2_of(rival.result) > LEADS_WITHIN * chi2_of(best.result) or len(tried) > RIVALS_OF_TWO:
            break
        if any(abs(chi2_of(t.result) / chi2_of(rival.result) - 1) < (SAME_OF_KIN if of_one_family(t, rival) else SAME) for t in tried):
            continue
        tried.append(rival)
        scores = screened(rival.result, task.choices)
        if means(rival.result, scores):
            return None, scores
        first, excess = scores[0], excess_of(rival.result)
        promised = chi2_of(rival.result) - first.z**2
        if first.z**2 > HALF * excess and promised < chi2_of(best.result) - MIN_DROP:
            ahead.append((promised, rival, scores))
    least = chi2_of(standing) - max(BIC_DROP, HALF * excess_of(standing))
    of_one = np.log(best.result.data_count)  # what BIC charges a parameter
    useful = min(PAIRS_END * near * best.result.data_count, least + best.parameters * of_one)  # a pair that cannot come there ends early

    def beside(rival, second):
        return lambda say: to_the_end(task.on(progress=say), rival.result, second, excess_of(rival.result), useful)

    def serves(rival, pair):
        cost = (rival.parameters + pair.parameters - best.parameters) * of_one
        return pair.physical and pair.result.chi2_per_sample < near and chi2_of(pair.result) + cost < least

    for _, rival, scores in sorted(ahead, key=lambda row: row[0]):
        seconds = [c for c in scores[:AHEAD] if abs(c.z) >= AS_HIGH * abs(scores[0].z)]  # at null one law scores about as its like
        found = functools.partial(serves, rival)
        pairs = together(
            [beside(rival, c) for c in seconds], task.progress, lambda k, ended, found=found: k not in ended and any(map(found, ended.values()))
        )
        if any(pair is not None and found(pair) for pair in pairs):
            return rival, scores
    return best, left


def refitted(task, current, best, good, excess, any_rest: bool = True, any_density: bool = True):
    """The best with another start memory and with a finer density where it still leaves something: both were chosen under
    the misfit of the base. Where it leaves much of which nothing further promises half, only the finest hats, which must take half
    of it. Where that changes them, the near rivals are tried again on the same. Returns the best, the trials beside it, and the
    task with what was chosen.

    Start memories that serve as well foretell other mean levels: the one that is tried first stands unless another is
    better by MIN_DROP. A density with steps is looked for anew, from the first hats on.
    """
    found = chosen = task.choices
    free = dataclasses.replace(chosen, rest="auto")
    order = sum(rests_of(task.bench, free), ())
    any_rest = any_rest and len(order) > 1
    if any_rest and (chosen.rest != order[0] or best.result.chi2_per_sample > REST_SETTLED and not memory_is_told(best.result)):
        known, ended = best.result.problem, best.result.solution
        noise = max(ended.chi2 / known.data_count, 1.0)
        target = (against_memory([(known, ended)])[0] + MIN_DROP) * noise  # beyond it no levels, however calm, speak for another
        other = task.fit_on(best.result, best.result.actuator, choices=free, target=target)
        margin = MIN_DROP if order.index(other.choices.rest) < order.index(chosen.rest) else -MIN_DROP
        against = against_memory([(fit.problem, fit.solution) for fit in (other, best.result)])
        if against[0] < against[1] + margin:
            found = other.choices
    ahead, left, highest = best.result, best.result.chi2_per_sample, max(REFINE_BESIDE, LITTLE_LEFT * current.chi2_per_sample)
    if chosen.stiffness is not None and left < highest:  # steps that were found under the misfit may have taken some of it
        bare = on(found, knots=Choices().knots, cells=None)
        found = task.fit(best.result.actuator, choices=bare, spectra=best.result.spectra, refine=highest).choices
    elif any_density and finer_hats(chosen) and FINER_FROM[0] < left < highest:
        found = _density_beside(task, best.result, found, highest).choices
    elif any_density and left >= highest:
        for choices in hats_of_step(found, task.bench, 2):
            last = task.fit_on(best.result, best.result.actuator, choices=choices)
            if excess_of(last) < HALF * excess_of(best.result):
                found, ahead = choices, last
    if found == chosen:
        return best, good, task
    before, task = task, task.on(choices=found)
    near = [t for t in good if chi2_of(t.result) < chi2_of(best.result) + max(20 * TIE, 0.2 * chi2_of(best.result))]

    def anew(t):
        def one(say):
            told = task.on(progress=say)
            start = ahead if t is best else t.result
            result = told.fit_on(start, start.actuator)  # from the plain fit's density, of another memory, it may end far off
            return settled(told, current, credited(t.candidate, result, current, result.actuator.effect(t.name), excess), excess)

        return one

    again = [t for t in together([anew(t) for t in near], task.progress) if t.physical]
    ended = min(again, key=lambda t: t.bic_change, default=best)
    met = chosen.stiffness is not None and ended.result.chi2_per_sample < FINER_FROM[0]  # without the freedom of those steps
    if not again or (chi2_of(ended.result) > chi2_of(best.result) + MIN_DROP and not met):
        return best, good, before
    far = [t for t in good if t.name not in {a.name for a in again}]  # no rivals alone, but they may be beside a later effect
    return ended, [*again, *far], task


def _density_beside(task, at_hand, choices, highest):
    """The fit with a density chosen beside the effects of the one at hand: from scratch, for that has bent to what was missing; from
    the one at hand where that ends above it."""
    anew = task.fit(at_hand.actuator, choices=choices, spectra=at_hand.spectra, refine=highest)
    if chi2_of(anew) < chi2_of(at_hand) + MIN_DROP:
        return anew
    return task.fit_on(at_hand, at_hand.actuator, choices=choices, refine=highest)
