"""One round of the search: the leaders of a screening fitted side by side, their families, and rivals on equal terms."""

import numpy as np

from .attribute import (
    CLOSE,
    COMPANIONS,
    FEEDBACKS,
    MIN_DROP,
    MISFIT,
    ROUGH_CHI2,
    SETTLED_CHI2,
    STRUCTURES,
    TIE,
    UNLIKE_NULL,
    WEAK_TIE,
    WORTH,
    Trial,
    chi2_of,
    credited,
    family,
    finite_chi2,
    in_detail,
    of_one_family,
    settled,
    try_effect,
)  # fmt: skip
from .together import SIDE_BY_SIDE, let_go, together
from .verdict import Z_THRESHOLD

IMITATES = 0.8  # share of a misfit that one effect takes where it may stand for two, which must then meet the noise
FAR_BEHIND = 2.0  # times the chi2/N of one that is left with more than noise, at which its kin are fitted from where it ended
NEAR_IN_DETAIL = 0.25  # of the fall of the best that meets the noise, within which others get the details of their laws, too


def try_all(task, current, top, candidates, excess, under_way, near: float = 2 * WEAK_TIE[1]) -> list[Trial]:
    """The leaders fitted beside the current fit, two side by side, until one meets the noise; then the family of the best.
    `under_way`: a dict that is given each trial by name as soon as it has ended; `near`: as of `worth_ending`."""
    trials = []

    def useful(*others):
        return min((chi2_of(t.result) for t in (*trials, *others) if t.physical), default=np.inf) + near

    def kept(trial):
        under_way[trial.name] = trial
        return trial

    def begun(c, target):
        return lambda say: kept(try_effect(task.on(progress=say), current, c, excess, target))

    def ended(t, target):
        return lambda say: kept(settled(task.on(progress=say), current, t, excess, target))

    def attempt(these):
        task.say(f"trying {' and '.join(c.name for c in these)}", current.chi2_per_sample)
        first = together(
            [begun(c, useful()) for c in these], task.progress, lambda k, results: _needless(these[k], results.values())
        )
        for c, t in zip(these, first, strict=True):
            if t is None:  # needless, ended or not
                under_way.pop(c.name, None)
        first = [t for t in first if t is not None]
        trials.extend(together([ended(t, useful(*(f for f in first if f is not t))) for t in first], task.progress))
        nearest = min(trials, key=lambda t: finite_chi2(t.result), default=None)
        let_go(current.actuator, *([nearest.result.actuator] if nearest else []))

    least = WORTH * abs(top[0].z)
    while top:
        attempt(top[:SIDE_BY_SIDE])
        top = [c for c in top[SIDE_BY_SIDE:] if not _needless(c, trials)]
    best = min((t for t in trials if t.physical), key=lambda t: t.bic_change, default=None)
    like = family(best.candidate, candidates, {t.name for t in trials}) if best else []
    if best and best.explained_share < IMITATES and best.result.chi2_per_sample > ROUGH_CHI2:
        # none takes most: a strong effect may act unlike its derivative at null
        known = {t.name for t in trials} | {c.name for c in like}
        others = [c for c in candidates if c.name not in known and c.visibility > 1e-3]
        like += [c for c in others if abs(c.z) > (Z_THRESHOLD if c.name in UNLIKE_NULL else least)]
    if best:
        known = {t.name for t in trials} | {c.name for c in like}
        like += [c for c in candidates if c.name in FEEDBACKS and c.name not in known and abs(c.z) > Z_THRESHOLD]
    for k in range(0, len(like), SIDE_BY_SIDE):
        attempt(like[k : k + SIDE_BY_SIDE])
    return _on_equal_terms(task, current, _led(task, current, trials, excess), excess)


def _led(task, current, trials, excess) -> list[Trial]:
    """The trials; where one meets the noise, its kin that ended in a misfit are fitted from where it ended, too: the density under
    it is the right one, and that of the current fit, which has bent to what is missing, may hold them far off. So where it takes most of
    a misfit and comes near the noise, those that are left with a multiple of what it leaves."""
    ahead = min(trials, key=lambda t: finite_chi2(t.result), default=None)
    if ahead is None:
        return trials
    left = ahead.result.chi2_per_sample
    if not left < (ROUGH_CHI2 if ahead.explained_share > IMITATES else SETTLED_CHI2):
        return trials
    kin, most = COMPANIONS.get(ahead.name, ()), MISFIT if left < SETTLED_CHI2 else FAR_BEHIND * left
    far = [t for t in trials if t.result.chi2_per_sample > most and t.name != ahead.name and (t.name in kin or of_one_family(t, ahead))]
    if not far:
        return trials
    target = chi2_of(ahead.result) + 2 * WEAK_TIE[1]
    base = ahead.result.actuator.without_effect(ahead.name)

    def from_there(t):
        effect = t.result.actuator.effect(t.name)

        def one(say):
            result = task.on(progress=say).fit_on(ahead.result, base.with_effect(effect), choices=ahead.result.choices, target=target)
            return credited(t.candidate, result, current, effect, excess)

        return one

    better = {t.name: t for t in together([from_there(t) for t in far], task.progress)}
    return [min(t, better.get(t.name, t), key=lambda x: finite_chi2(x.result)) for t in trials]


def _on_equal_terms(task, current, trials, excess) -> list[Trial]:
    """The trials; of those that meet the noise and come near the best, each with the details of its law.

    Where the noise is met nobody asks for details, and a law with more shapes wins by the form of the right one's.
    """
    good = [t for t in trials if t.physical and t.drop > MIN_DROP]
    best = min(good, key=lambda t: t.bic_change, default=None)
    if best is None or best.result.chi2_per_sample > MISFIT:
        return trials
    near = best.bic_change + max(2 * TIE, NEAR_IN_DETAIL * best.drop)
    near = [t for t in good if t.bic_change < near and t.result.chi2_per_sample < MISFIT]
    if len(near) < 2:
        return trials

    def detailed(t):
        return lambda say: in_detail(task.on(progress=say), current, t, excess)

    found = dict(zip(map(id, near), together([detailed(t) for t in near], task.progress), strict=True))
    return [found.get(id(t), t) for t in trials]


def _needless(candidate, trials) -> bool:
    """Whether a leader that meets the noise leaves only close rivals to try, and this is none: no companion of it and no feedback, whose
    scores say little."""
    near = WORTH if candidate.name in FEEDBACKS else CLOSE
    met = [t for t in trials if t.physical and t.result.chi2_per_sample < SETTLED_CHI2]
    others = [t for t in met if candidate.name not in COMPANIONS.get(t.name, ())]
    return candidate.name not in STRUCTURES and any(abs(candidate.z) < near * abs(t.candidate.z) for t in others)
