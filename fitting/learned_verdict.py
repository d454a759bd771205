"""What a diagnosis makes of a learned term: the model of an `unknown_at`, or the better word in place of effects that were named."""

import dataclasses

import numpy as np

from .attribute import AT_NOISE, MISFIT
from .check import check_errors, foretold_text
from .diagnosis import misfit
from .learned import Learned, learn, left_out
from .learned_function import described, region
from .verdict import WORSE, asked_for

WRONG_NAME = 0.25  # of what an effect leaves above the noise, that a learned function leaves where the effect is the wrong name
MANY = 3  # effects in place of which a function that leaves no more is the better word: so many at once are seldom missing
LEAVES_MISFIT = MISFIT  # chi2/N beside an effect that was named, from which a learned function is tried in its place;
NARROW = 0.35  # of the range, within which one at its own block bends where no form of its law does: a stop, a kink;
CONFIRMED = 0.8  # of what that effect misses check recordings by, that it may leave
AS_MUCH, FORETOLD = 1.1, 0.5  # of the chi2 of effects on finer hats, and of what they miss check recordings by, that one may leave


def better_learned(base, named, blocks, recordings, bench, number: int = 1, check=(), progress=None) -> Learned | None:
    """A term that shows effects to be the wrong names: in another block than `blocks`, it leaves next to nothing of what they
    leave, or no more than `MANY` do, and foretells recordings left out better, and check recordings no worse; in place of one effect it
    must be as simple, and may be at its block where it bends in one `NARROW` place and check recordings say so. Of effects that leave a
    misfit on a density finer than the base's, it may leave as much, where it takes most of what they miss check recordings by. None elsewhere.

    `base`: the plain fit; `named`: that with the effects, their `number`.
    """
    most = AT_NOISE + (WRONG_NAME if number < MANY else 1.0) * max(named.chi2_per_sample - AT_NOISE, 0.0)  # chi2/N
    hats, chosen = base.choices.knots, named.choices.knots
    finer = named.chi2_per_sample > LEAVES_MISFIT and None not in (hats, chosen) and chosen > hats
    learned = learn(base, recordings, bench, progress, np.inf if finer else most * named.data_count)
    if learned is None or not (number > 1 or learned.place.simple):
        return None
    same = learned.place.block in blocks
    if same and (number > 1 or not region(learned)[2] < NARROW):
        return None
    rows = check_errors(named.actuator, learned.result.actuator, check, bench)
    before, after = misfit(rows, "rms_before"), misfit(rows, "rms_after")
    if after > WORSE[0] * before + WORSE[1] * len(rows):
        return None
    if same and not after < CONFIRMED * before:
        return None
    left = learned.result.chi2_per_sample
    if left <= most and not learned.left_out[1] > left_out(named.problem, named.solution).mean():
        return learned
    return learned if finer and not same and left < AS_MUCH * named.chi2_per_sample and after < FORETOLD * before else None


def with_learned_term(found, base, recordings, bench, check=(), progress=None, learned=None):
    """An `unknown_at` with the term that models it, where one is worth it: block and region by it, the repaired model with
    it, check recordings before and after. `found`: a `Diagnosis`; `base`: the fit that it stands beside; `learned`: the term,
    where it is known."""
    learned = learned or learn(base, recordings, bench, progress)
    if learned is None:
        return dataclasses.replace(
            found, message=found.message + " No smooth function of the signals takes most of it and foretells recordings left out any better."
        )
    rows = tuple(check_errors(found.base.actuator, learned.result.actuator, check, bench)) if check else ()
    gained = [r["rms_after"] / max(r["rms_before"], 1e-300) for r in rows]
    if gained and np.mean(np.square(gained)) > 1:
        return dataclasses.replace(
            found,
            message=found.message + " A smooth function learned from the recordings of the fit predicts the check recordings worse, so it is not kept.",
        )
    more = described(learned)
    start, end, part = region(learned)
    place, unit, words = learned.place, more["variable_units"][0], bench.terms.word
    where = (
        f"all over the range of the {words(place.variables[0])}"
        if part > 0.6
        else f"{words(place.variables[0])} {start:.3g} .. {end:.3g} {unit}"
    )
    unknown = {**(found.unknown or {}), "block": place.block, "region": where, **more}
    nearest = f"{learned.share:.0%} of the excess"
    text = (
        f"something is missing that no effect {asked_for(base.choices.only)} explains. It acts like a function of {place.joined(words)} "
        f"at the {place.block} ({where}): learned as one, it takes {nearest} (chi2/N {base.chi2_per_sample:.3g} -> {learned.result.chi2_per_sample:.3g}; "
        f"recordings left out {learned.left_out[0]:.3g} -> {learned.left_out[1]:.3g})."
    )
    if learned.rivals:
        rivals = [f"{p.block} ({p.joined(words)})" for p in learned.rivals]
        text += f" Not told from it: {'; '.join(rivals)}."
    text += foretold_text(rows)
    text += " Beyond the range seen its interval widens."
    return dataclasses.replace(found, message=text, unknown=unknown, check=rows or found.check, repaired=learned.result)
