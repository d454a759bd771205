"""What a misfit owes to the density: told from physics by what the scores tell, by the check recordings, and by masses of cells."""

import dataclasses

import numpy as np

from .attribute import FEEDBACKS, LIKE_DENSITY, MIN_DROP, ROUGH_CHI2, SETTLED_CHI2, chi2_of, excess_of
from .diagnosis import Evidence, misfit
from .finer import FINER_FROM, FINEST_BELOW, REFINE_BELOW, cells_beside, finer_hats, finest
from .screen import screened
from .search import SECOND_Z, search
from .setup import Choices
from .task import freed_beyond
from .together import together
from .verdict import FULL_SHARE, HALF, NULL_CHI2, Z_THRESHOLD, as_expected, like_density, too_little

FORETOLD = 0.3  # of the check recordings' misfit that a repair may leave: of their sum, and of the middle one
CLEAR_Z = 20.0  # the score of an effect that no density imitates: on nulls at chi2/N of 3 the highest are 6 to 7
NEXT_TO_IT = 0.3  # of its score
CELLS_BETTER = 0.95  # of the hats' generalized cross-validation, that cells must end below
CELLS_ALONE, CELLS_LEAVE = 0.9, 1.45  # the same where they are to explain a misfit alone, and the chi2/N that they must come below
VERY_ROUGH_CHI2 = 6.0  # chi2/N that a density may leave where the scores tell nothing
NOTHING_OF_IT = 0.04  # of a misfit, as the square of the highest score: physics outside the catalogue looks more like some of it


def without_chance(evidence) -> Evidence:
    """The evidence without effects that take less than half of a misfit of which the scores tell nothing, or leave one though
    the density bends to them: they move its steps about by chance."""
    steps = evidence.reached.steps
    by_chance = evidence.missing and like_density(evidence)
    if not steps or not _tells_nothing(evidence) or (evidence.share > HALF and not by_chance):
        return evidence
    reached = dataclasses.replace(evidence.reached, current=evidence.plain, steps=[], form=None)
    return dataclasses.replace(evidence, reached=reached)


def _told(result, candidates) -> float:
    """The highest score of an effect that a density cannot pass for; on the finest hats in the unit of what these leave beyond
    ROUGH_CHI2, which acts as further noise, and of a feedback, which bends the field as their steps do, what it has of CLEAR_Z."""
    last = finest(result.choices)
    unit, feedback = (np.sqrt(max(result.chi2_per_sample / ROUGH_CHI2, 1.0)), SECOND_Z / CLEAR_Z) if last else (1.0, 1.0)
    scores = (abs(c.z) * (feedback if c.name in FEEDBACKS else 1.0) for c in candidates if c.name not in LIKE_DENSITY)
    return float(max(scores, default=0.0) / unit)


def worth_a_search(plain, candidates):
    """The candidates; none where the finest hats leave much and nothing scores beyond what such a density does, but where few are
    asked for."""
    much = finest(plain.choices) and REFINE_BELOW <= plain.chi2_per_sample < FINEST_BELOW
    return [] if much and not plain.choices.only and _told(plain, candidates) < SECOND_Z else candidates


def _tells_nothing(evidence) -> bool:
    """Whether no effect that a density cannot pass for scores beyond what a rough one leaves, or all next to nothing of the misfit;
    not known where few are asked for."""
    if evidence.only:
        return False
    highest = max((c.z**2 for c in evidence.candidates if c.name not in LIKE_DENSITY), default=0.0)
    told = _told(evidence.plain, evidence.candidates)
    return told < SECOND_Z or (not finest(evidence.plain.choices) and highest < NOTHING_OF_IT * excess_of(evidence.plain))


def is_rough(evidence, checks) -> bool:
    """Whether what is left is the density's: little (on the finest hats FINEST_BELOW), and nothing scores beyond what a rough one
    leaves and nothing earned its place; or what earned it is clear of any density; or a finer density was asked for and what is named
    foretells the check recordings, which took no part, or explains all but a little and errs on them as it expects (without any,
    it must explain all but a little).

    A smooth function could always be learned from it, and would be no physics.
    """
    steps, current = evidence.reached.steps, evidence.reached.current
    told = finest(evidence.plain.choices)
    if not steps:
        nothing = not evidence.reached.partial and _tells_nothing(evidence)
        return nothing and evidence.excess < (FINEST_BELOW if told else VERY_ROUGH_CHI2)
    if not evidence.excess < (REFINE_BELOW if told else ROUGH_CHI2):
        return False
    if too_little(evidence.reached, evidence.plain):
        return True
    if _clear(evidence):
        return True
    choices = current.choices
    finer = choices.knots[0] > Choices().knots[0] if choices.knots is not None else choices.rest != "held"
    if not checks:
        return finer and evidence.share > FULL_SHARE
    if finer and evidence.share > FULL_SHARE and as_expected(evidence):
        return True
    before, after = ([misfit([row], which) for row in checks] for which in ("rms_before", "rms_after"))
    left = [a / b for a, b in zip(after, before, strict=True) if b > 1]  # of those that leave something to foretell
    return finer and sum(before) > len(checks) and sum(after) < FORETOLD * sum(before) and bool(np.median(left) < FORETOLD)


def _clear(evidence) -> bool:
    """Whether what was found scored far beyond what a rough density ever leaves, takes most of a misfit that one may leave, and
    leaves nothing that scores beyond that, or next to what it scored itself. On the finest hats, where a rough density scores next
    to nothing, it need not take most (scores as in `_told`)."""
    first = evidence.reached.steps[0][0].candidate
    plain, current = evidence.plain, evidence.reached.current
    told = finest(plain.choices)
    if first.name in LIKE_DENSITY or (plain.chi2_per_sample > REFINE_BELOW and not told):
        return False
    if (_told(plain, [first]) < SECOND_Z) if told else (abs(first.z) < CLEAR_Z or evidence.share < HALF):
        return False
    if not told:
        return _highest_beside(current) < max(SECOND_Z, NEXT_TO_IT * abs(first.z))
    beside = screened(current, current.choices)
    return _told(current, beside) < SECOND_Z or _told(plain, beside) < NEXT_TO_IT * _told(plain, [first])


def on_cells_alone(task, evidence) -> Evidence | None:
    """The same with nothing but masses of cells, where they alone come near the noise, foretell what was left out better than
    hats, and leave an effect that was found less than half of the rest to take. None elsewhere.

    A density of rough cells leaves chi2/N of 1.5 to 3 on hats, and a law that bends the loops takes some of it by chance.
    Cells take up physics as well, but leave more of it: that it comes near the noise on them is what tells.
    """
    current, plain = evidence.reached.current, evidence.plain
    near = SETTLED_CHI2 < current.chi2_per_sample < ROUGH_CHI2 and plain.chi2_per_sample < REFINE_BELOW
    if task.bench.drive != "current" or evidence.adopted or plain.choices.knots is None or not near:
        return None
    cells = min(_fits_on(task, plain, cells_beside(plain.choices)), key=_cross_validation)
    if not (cells.chi2_per_sample < CELLS_LEAVE and _cross_validation(cells) < CELLS_ALONE * _cross_validation(plain)):
        return None
    if evidence.reached.steps:
        beside = task.fit_on(cells, current.actuator, choices=cells.choices, extra=freed_beyond(current))
        if chi2_of(cells) - chi2_of(beside) > max(MIN_DROP, HALF * excess_of(cells, NULL_CHI2)):
            return None
    reached = dataclasses.replace(evidence.reached, current=cells, steps=[], form=None)
    return dataclasses.replace(evidence, reached=reached, raw=cells, plain=cells)


def beside_cells(task, evidence) -> Evidence | None:
    """The same with masses of cells and what a search beside them finds, where these foretell what was left out better than hats
    and the search ends near the noise, with effects that take what they promised and nothing else that scores. None elsewhere.

    On hats a rough density leaves more than a weak effect, which then explains too little of the misfit to be named.
    """
    steps, current, plain = evidence.reached.steps, evidence.reached.current, evidence.plain
    near = current.chi2_per_sample < ROUGH_CHI2 and plain.chi2_per_sample < REFINE_BELOW
    if not steps or task.bench.drive != "current" or evidence.adopted or plain.choices.knots is None or not near:
        return None
    task.say("on masses of cells", current.chi2_per_sample)
    cells = min(_fits_on(task, plain, cells_beside(plain.choices)), key=_cross_validation)
    if not _cross_validation(cells) < CELLS_BETTER * _cross_validation(plain):
        return None
    first, _, good, _ = steps[0]
    # what moves the cells about finds steps of the density elsewhere, and is no evidence of itself
    worth = {t.name for t in good if t.drop > HALF * first.drop and t.name not in LIKE_DENSITY}
    candidates = screened(cells, task.choices)
    reached = search(task, cells, [c for c in candidates if c.name in worth], evidence.checks[1])
    if reached.late or not reached.steps or not reached.current.chi2_per_sample < CELLS_LEAVE or reached.form:
        return None
    if len(reached.steps) == 1:  # of rivals those that leave nothing that scores
        _, tied, good, _ = reached.steps[0]
        tied = [t for t in tied if _highest_beside(t.result) < SECOND_Z]
        if not tied:
            return None
        reached = dataclasses.replace(reached, current=tied[0].result, steps=[(tied[0], tied, good, cells)])
    taken = chi2_of(cells) - chi2_of(reached.current)
    if taken < max(MIN_DROP, HALF * excess_of(cells, NULL_CHI2), HALF * first.candidate.z**2):
        return None
    if _highest_beside(reached.current) > Z_THRESHOLD:
        return None
    return dataclasses.replace(evidence, reached=reached, raw=cells, plain=cells, candidates=tuple(candidates))


def _highest_beside(result) -> float:
    """The highest score of any further effect."""
    return max((abs(c.z) for c in screened(result, result.choices)), default=0.0)


def on_better_density(task, evidence) -> Evidence | None:
    """The same with masses of cells, finer hats or the plain fit's steps in the final model, where they promise to foretell better;
    None elsewhere.

    After the verdict, for cells take up physics too, which hats leave for an effect to explain, and so may steps that were found
    without it. By generalized cross-validation: on densities that hats follow, cells lower chi2 and foretell far worse.
    """
    current, plain = evidence.reached.current, evidence.plain
    if task.bench.drive != "current" or (current is plain and evidence.raw is not plain):
        return None
    far = current.chi2_per_sample > FINER_FROM[1]
    densities = (*finer_hats(current.choices), *cells_beside(current.choices)) if far else ()
    if plain.choices.stiffness is not None and current.choices.stiffness is None:
        steps = {n: getattr(plain.choices, n) for n in ("level", "knots", "cells", "stiffness")}
        densities = (*densities, dataclasses.replace(current.choices, **steps))
    best = min(_fits_on(task, current, densities), key=_cross_validation, default=current)
    if not _cross_validation(best) < CELLS_BETTER * _cross_validation(current):
        return None
    finer = dataclasses.replace(evidence, reached=dataclasses.replace(evidence.reached, current=best))
    return dataclasses.replace(finer, raw=best, plain=best) if current is plain else finer


def _fits_on(task, result, densities) -> list:
    """Fits of the same on other densities."""
    same = {"extra": freed_beyond(result), "spectra": result.spectra, "refine": False}

    def on(choices):
        return lambda say: task.on(progress=say).fit(result.actuator, choices=choices, **same)

    return together([on(choices) for choices in densities], task.progress)


def _cross_validation(result) -> float:
    """Generalized cross-validation of a fit, up to a factor (Golub, Heath and Wahba, Technometrics 21, 1979)."""
    return chi2_of(result) / (result.data_count - result.unknowns) ** 2
