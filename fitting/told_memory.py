"""The start memory that check recordings tell, where those of the fit do not.

Relays that a recording never switches stay as they began, and add a constant to its M. From another start memory a density fits as
well that fills them differently; one that was recorded with a larger drive, or about another bias, then misses by far.
"""

import dataclasses

import numpy as np

from .attribute import MIN_DROP, chi2_of
from .exchange import missed
from .memories import against_memory, apart, rests_of
from .task import freed_beyond
from .together import together

STRONG = 6.0  # twice the logarithm of a Bayes factor from which it is strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773)


def told_by_checks(task, current, foretell):
    """The current fit from the start memory that the check recordings tell: where these are missed, in the mean by more than 1.4 of
    their noise, and the recordings of the fit are met as well from that one. None elsewhere, and where the bench states one.

    `foretell`: a `Foreteller`. What either kind of recording says is added up: the misfit of the ones, the predictive density of
    the others, which grants each fit what it expects to miss.
    """
    rests = rests_of(task.bench, task.choices)[0]
    if len(rests) < 2 or not foretell or foretell(current) is None:
        return None
    if not missed(current, [foretell.recordings[k] for k in foretell.places], task.bench):
        return None
    rests = [rest for rest in apart(rests, current.problem) if rest != current.choices.rest]
    task.say("another start memory", current.chi2_per_sample)

    def fitted(rest):
        choices = dataclasses.replace(current.choices, rest=rest)
        options = {"choices": choices, "extra": freed_beyond(current), "target": chi2_of(current) + MIN_DROP}
        return lambda say: task.on(progress=say).fit_on(current, current.actuator, **options)

    def said_for(other) -> float:
        against, before = against_memory([(fit.problem, fit.solution) for fit in (other, current)])
        return foretell.says_for(other, current) - (against - before) if against < before + MIN_DROP else -np.inf

    said = [(said_for(other), other) for other in together([fitted(rest) for rest in rests], task.progress)]
    most, best = max(said, key=lambda row: row[0], default=(0.0, None))
    return best if most > STRONG else None
