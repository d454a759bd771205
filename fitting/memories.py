"""Start memories: which may be tried, and which one the recordings had, by what a fit leaves and by their levels."""

import numpy as np

from .setup import field_of_rest

RESTS = {  # a rod is demagnetized with its bias on, or before that was put on
    "negative_saturation": ("negative",), "demagnetized": ("demagnetized", "virgin"), "positive_saturation": ("positive",),
}  # fmt: skip
STATES = {  # in words
    "negative": "negative saturation", "demagnetized": "the demagnetized state", "virgin": "the demagnetized state, without bias", "positive": "positive saturation",
}  # fmt: skip
RESTS_IN_ORDER = tuple(found[0] for found in RESTS.values())
CALM = 0.25  # mean square of the recordings' levels in units of their prior, above which another start memory is tried
STRAINED = 4.0  # the same above which it is most likely a wrong one; of the right one CALM at the most, of others some tens and more
REST_SETTLED = 1.15  # chi2/N below which no other start memory is tried


def rests_of(bench, choices):
    """Start memories to try, in order: those that the bench states, and those that stand in where none of these serves."""
    if choices.rest != "auto":
        return (choices.rest,), ()
    if isinstance(bench.start, tuple):  # a history of fields
        return ("negative",), ()
    if bench.start not in RESTS:
        return RESTS_IN_ORDER, ()
    stated = RESTS[bench.start] if bench.drive == "current" else RESTS[bench.start][:1]  # no bias to put on
    return stated, tuple(rest for rest in RESTS_IN_ORDER if rest not in stated)


def _strain(problem, solution) -> float:
    """Sum of the squared levels of the recordings, each in units of its prior: a wrong start memory strains them."""
    levels = solution.z[len(solution.z) - problem.layout.memories :]
    return float(levels @ levels)


def settled(problem, solution) -> bool:
    """Whether no other start memory need be tried; levels that strain their prior tell of a wrong one even where the recordings
    are met."""
    return _strain(problem, solution) <= CALM * problem.layout.memories and solution.chi2 < REST_SETTLED * problem.data_count


def is_strained(problem, solution) -> bool:
    """Whether the recordings' levels are as far from their prior as those beside a wrong start memory."""
    return _strain(problem, solution) > STRAINED * problem.layout.memories


def believed(ended, stated):
    """Of fits from several start memories, (problem, solution, choices), those from the `stated` ones and the others that contradict
    these: one that meets the noise with calm levels, or with levels that are not strained where those of all stated ones are."""
    own, others = ([row for row in ended if (row[2].rest in stated) == kind] for kind in (True, False))
    strained = all(is_strained(*row[:2]) for row in own)
    met = [row for row in others if row[1].chi2 < REST_SETTLED * row[0].data_count and not is_strained(*row[:2])]
    return own + [row for row in met if strained or settled(*row[:2])]


def memory_is_told(result) -> bool:
    """Whether the recordings' levels say that their start memory is the right one: beside any other they are seldom calm."""
    memories = result.problem.layout.memories
    return memories > 0 and _strain(result.problem, result.solution) <= CALM * memories


def against_memory(fits) -> list[float]:
    """What speaks against the start memory of each fit of the same recordings: pairs of a problem and its solution.

    Chi2 and the levels' strain where the noise is met. What a density too coarse, or missing physics, leaves acts as further
    noise of the harmonics, as large as the best leaves: that one memory leaves a little less of it than another tells nothing,
    for each density bends to it in its own way. The levels of the right memory stay calm meanwhile; those of others are off by tens of
    their prior.
    """
    noise = max(1.0, min((found.chi2 / known.data_count for known, found in fits if np.isfinite(found.chi2)), default=1.0))
    against = [found.chi2 / noise + _strain(known, found) for known, found in fits]
    return [value if np.isfinite(value) else np.inf for value in against]


def best_memory(ended):
    """Of fits from several start memories, (problem, solution, choices), the first that is settled, else the best."""
    for row in ended:
        if settled(*row[:2]):
            return row
    return ended[int(np.argmin(against_memory([row[:2] for row in ended])))]


def apart(rests, problem):
    """Those that are not the same as one before: where the bias is strong, what was demagnetized without it is saturated."""
    plane = problem.template.hysteresis
    fields = [field_of_rest(rest, problem.template, float(plane.low), float(plane.high)) for rest in rests]
    return [rest for k, rest in enumerate(rests) if fields[k] not in fields[:k]]
