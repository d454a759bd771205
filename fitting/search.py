"""The search: leaders of the screening are fitted for real, the best is adopted while it earns its place, and screened again.

Forward here; what is adopted once more, beside those that came later, in `exchange`.
"""

import dataclasses

import numpy as np

from .attribute import (
    BIC_DROP,
    CLOSE,
    COMPANIONS,
    FEEDBACKS,
    LIKE_DENSITY,
    MIN_DROP,
    MISFIT,
    SETTLED_CHI2,
    STRUCTURES,
    THRESHOLDS,
    TIE,
    WEAK_TIE,
    WORTH,
    Trial,
    chi2_of,
    credited,
    excess_of,
    family,
    finite_chi2,
    in_detail,
    leaders,
    of_one_family,
    rivals_of,
    settled,
    to_the_end,
    try_effect,
)
from .check import check_errors
from .diagnosis import SILENT_CHI2
from .exchange import backward, both_found, commuted, exchange
from .finer import FINER_FROM, REFINE_BESIDE, finer_hats, finest, hats_of_step
from .foretold import Foreteller
from .memories import REST_SETTLED, against_memory, memory_is_told, rests_of
from .rows import SLOW
from .screen import screened
from .task import Late
from .together import SIDE_BY_SIDE, let_go, together
from .verdict import FAR_FROM_NOISE, HALF, Z_THRESHOLD

MAX_EFFECTS = 3
HOPELESS = 2.0  # times what a repair may leave, after two effects
LEAST_SHARE = 0.3  # of what the first effects leave above the noise, that a further one must take
BEYOND_PROMISE = 3.0  # times what it promises to first order, that an effect may take
LITTLE_LEFT = 0.2  # share of a chi2/N that an effect may leave for a finer density to be tried beside it, however far that is
FAR_BESIDE = 2.0  # chi2/N beside an effect from which a further one is asked for before a finer density
LEADS_WITHIN, RIVALS_OF_TWO, SAME = 5.0, 3, 1e-3  # of the best's chi2, how many, and how far apart in theirs
IMITATES = 0.8  # share of a misfit that one effect takes where it may stand for two, which must then meet the noise
FORM_ERROR = 0.005  # of what the effects found take: as little as that is left by their laws' form, and names nothing further,
WHOLE = 1.0, 0.9  # unless it ends at this chi2/N and takes that share of a misfit: another law seldom has just their form
NEAR_IN_DETAIL = 0.25  # of the fall of the best that meets the noise, within which others get the details of their laws, too
DECISIVE = 0.7  # share of what the first effect leaves, that a further one takes where check recordings need not confirm it
HIDES = 2.0  # chi2 per number of check recordings in units of what the fit expects to miss, from which a density may hide a feedback,
HIDDEN_DROP = 6.0  # and the fall of chi2 by that one; on nulls it was 4 at most
SECOND_Z = 8.0  # a further effect where the noise is met already: what a rough density leaves scores 6 to 7; check recordings
# that say for it count as much


@dataclasses.dataclass
class Reached:
    """The current fit, adopted trials with their rivals, all trials of the last round.

    `form`: an effect in the current fit that was not adopted: it makes up for the form of the laws of those that were;
    `foretell`: what fits say of the check recordings; `under_way`: trials by name of a round that has not come to its end;
    `unsure`: the score that what that round finds must reach with what check recordings say for it, 0 where they need not;
    `late`: whether the time was over before the search was through; `partial`: whether what was reached stands on a round that
    did not come to its end.
    """

    current: object
    steps: list
    tried: dict
    form: str | None = None
    foretell: Foreteller | None = None
    under_way: dict = dataclasses.field(default_factory=dict)
    unsure: float = 0.0
    late: bool = False
    partial: bool = False

    def adopt(self, best, good):
        """Go on from a trial, beside the others that earned their place."""
        self.steps.append((best, rivals_of(best, good), good, self.current))
        self.current, self.under_way = best.result, {}


def search(task, base, candidates, check=(), ends=lambda current: False, free_means=lambda fit, best, beside=(): False) -> Reached:
    """Forward: fit the leaders, adopt the best while it earns its place; then screen again. `task`: a `Task`, of what
    `base` was fitted to; `ends(fit)`: whether the fit with an effect that was adopted makes the rest of the search needless;
    `free_means(fit, best)`: the same of that with a slow effect, whose means are not settled, beside the best; `free_means(best,
    best, scores)`: of the best, beside which means promise more than what scores. A timed task's search ends with what it has:
    the best that was fitted in a round under way, where the round would not have refused it."""
    state = Reached(base, [], {}, foretell=Foreteller(check, base))
    scored = {c.name: c for c in candidates}
    task = task.on(choices=base.choices)  # its density may be finer than the default: rivals get the same
    try:
        task, made_up, needless = _forward(task, base, state, candidates, check, ends, free_means)
        state.under_way = {}
        if not needless:
            _once_more(task, state, made_up, scored, check, ends)
    except Late:
        state.late = True
        state.partial = _adopt_of(state, base, check) or not state.steps
    state.steps = both_found(state.steps)
    return state


def _once_more(task, state, made_up, scored, check, ends):
    """What was adopted, once more beside what came later."""
    if state.current.chi2_per_sample < FAR_FROM_NOISE:
        backward(task, state, made_up)
        exchange(task, state, check)
        if commuted(task, state, scored.get("sensor_lag")):
            exchange(task, state, check)
    if state.steps and state.current is not state.steps[-1][0].result:
        ends(state.current)


def _forward(task, base, state, candidates, check, ends, free_means):
    """The rounds, into the `state`. Returns the task on the density that was chosen beside the effects, the candidate of
    `state.form`, and whether the rest of the search is needless."""
    any_rest, made_up = task.choices.rest == "auto", None
    for _round in range(MAX_EFFECTS):
        top = leaders(candidates)
        hidden = not top or abs(top[0].z) < Z_THRESHOLD
        if hidden:
            top = _hidden_feedbacks(state, candidates)
        if not top:
            break
        state.unsure = Z_THRESHOLD if hidden else SECOND_Z if _calm(state) and abs(top[0].z) < SECOND_Z else 0.0
        if state.unsure and not state.foretell:
            break
        if len(state.steps) > 1 and state.current.chi2_per_sample > HOPELESS * FAR_FROM_NOISE:  # not by one more
            break
        excess = max(excess_of(state.current), MIN_DROP)
        if state.steps and _hopeless(state.current, top[0], excess):
            break
        trials = _trials(task, state.current, top, candidates, excess, state.under_way)
        state.under_way.update((t.name, t) for t in trials)
        state.tried = {t.name: t.candidate for t in trials} | state.tried  # the first time beside the plain fit
        good, best = _best_of(trials) if not hidden else _best_hidden(trials)
        if best is None:
            break
        if any(free_means(t.result, best.result) for t in good if t.name in SLOW):
            return task, made_up, True
        if _takes_too_little(state, best, excess):
            break
        if _makes_up_for_form(state, base, best):
            if check and not _predicts_worse(state.current, best.result, state.foretell):
                state.current, state.form, made_up = best.result, best.name, best.candidate
            break
        if _not_confirmed(state, best, excess, check):
            break
        left = screened(best.result, task.choices)
        if best.name not in SLOW and free_means(best.result, best.result, left):
            return task, made_up, True
        if not state.steps and not _promises(base, best.result, left):
            best, left = _of_two(task, best, left, good)
        found, good, task = _finer(task, state.current, best, good, excess, any_rest, not _promises(base, best.result, left))
        candidates = left if found.result is best.result else screened(found.result, task.choices)
        state.adopt(found, good)
        let_go()
        if ends(state.current):
            return task, made_up, True
    return task, made_up, False


def _best_of(trials):
    """The trials that take enough for their parameters and are physical, and the best of them, or None."""
    good = [t for t in trials if t.physical and t.drop > MIN_DROP and t.bic_change < -BIC_DROP]
    return good, min(good, key=lambda t: t.bic_change + (0 if t.result.converged else 5), default=None)


def _best_hidden(trials):
    """The same of effects that a density hides from the recordings: the check recordings must speak for them."""
    good = [t for t in trials if t.physical and t.drop > HIDDEN_DROP]
    return good, max(good, key=lambda t: t.drop, default=None)


def _calm(state) -> bool:
    """Whether the effects found meet the noise."""
    return bool(state.steps) and state.current.chi2_per_sample < SILENT_CHI2


def _hidden_feedbacks(state, candidates) -> list:
    """Feedbacks that may be there though nothing scores: where the noise is met and check recordings are missed beyond what the fit
    expects, its density may have bent to one; these must then speak for it."""
    if not state.current.chi2_per_sample < SILENT_CHI2 or not state.foretell:
        return []
    told = state.foretell(state.current)
    return [c for c in candidates if c.name in FEEDBACKS] if told is not None and told.whitened > HIDES else []


def _takes_too_little(state, best, excess) -> bool:
    """Whether a further effect leaves most of a misfit."""
    return bool(state.steps) and best.drop < LEAST_SHARE * excess and state.current.chi2_per_sample > MISFIT


def _makes_up_for_form(state, base, best) -> bool:
    """Whether a further effect takes as little as the form of the laws of those found leaves."""
    return best.drop < FORM_ERROR * (chi2_of(base) - chi2_of(state.current)) and not _whole(state.current, best)


def _not_confirmed(state, best, excess, check) -> bool:
    """Whether check recordings speak against a further effect, or not for one of which the recordings are unsure."""
    further = state.steps and check and not _decides(state.current, best, excess)
    if further and _predicts_worse(state.current, best.result, state.foretell):
        return True
    return bool(state.unsure) and best.drop + _confirmed(state.current, best.result, state.foretell) < state.unsure**2


def _adopt_of(state, base, check) -> bool:
    """Adopt the best of the round under way, where there is one that it would not have refused; whether there was."""
    trials = list(state.under_way.values())
    state.tried = {t.name: t.candidate for t in trials} | state.tried
    good, best = _best_of(trials)
    excess = max(excess_of(state.current), MIN_DROP)
    if best is None or _takes_too_little(state, best, excess) or _makes_up_for_form(state, base, best):
        return False
    if _not_confirmed(state, best, excess, check):
        return False
    state.adopt(best, good)
    return True


def _hopeless(current, leader, excess) -> bool:
    """Whether a further effect on the finest hats, where each trial takes its time, promises far less than the least that it must take."""
    return finest(current.choices) and current.chi2_per_sample > MISFIT and BEYOND_PROMISE * leader.z**2 < LEAST_SHARE * excess


def _trials(task, current, top, candidates, excess, under_way) -> list[Trial]:
    """The leaders fitted beside the current fit, two side by side, until one meets the noise; then the family of the best.
    `under_way`: a dict that is given each trial by name as soon as it has ended."""
    trials = []

    def useful(*others):
        return min((chi2_of(t.result) for t in (*trials, *others) if t.physical), default=np.inf) + 2 * WEAK_TIE[1]

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
        let_go()

    least = WORTH * abs(top[0].z)
    while top:
        attempt(top[:SIDE_BY_SIDE])
        top = [c for c in top[SIDE_BY_SIDE:] if not _needless(c, trials)]
    best = min((t for t in trials if t.physical), key=lambda t: t.bic_change, default=None)
    like = family(best.candidate, candidates, {t.name for t in trials}) if best else []
    if best and best.explained_share < IMITATES and best.result.chi2_per_sample > FAR_FROM_NOISE:
        # none takes most: a strong effect may act unlike its derivative at null
        known = {t.name for t in trials} | {c.name for c in like}
        others = [c for c in candidates if c.name not in known and c.visibility > 1e-3]
        like += [c for c in others if abs(c.z) > (Z_THRESHOLD if c.name in THRESHOLDS else least)]
    if best:
        known = {t.name for t in trials} | {c.name for c in like}
        like += [c for c in candidates if c.name in FEEDBACKS and c.name not in known and abs(c.z) > Z_THRESHOLD]
    for k in range(0, len(like), SIDE_BY_SIDE):
        attempt(like[k : k + SIDE_BY_SIDE])
    return _on_equal_terms(task, current, _led(task, current, trials, excess), excess)


def _led(task, current, trials, excess) -> list[Trial]:
    """The trials; where one meets the noise, its kin that ended in a misfit are fitted from where it ended, too: the density under
    it is the right one, and that of the current fit, which has bent to what is missing, may hold them far off."""
    ahead = min(trials, key=lambda t: finite_chi2(t.result), default=None)
    if ahead is None or not ahead.result.chi2_per_sample < SETTLED_CHI2:
        return trials
    kin = COMPANIONS.get(ahead.name, ())
    far = [t for t in trials if t.result.chi2_per_sample > MISFIT and t.name != ahead.name and (t.name in kin or of_one_family(t, ahead))]
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
    """Whether a leader that meets the noise leaves only close rivals to try, and this is none."""
    met = [t for t in trials if t.physical and t.result.chi2_per_sample < SETTLED_CHI2]
    return candidate.name not in STRUCTURES and any(abs(candidate.z) < CLOSE * abs(t.candidate.z) for t in met)


def _whole(current, best) -> bool:
    """Whether an effect takes all that those before it leave, a clear misfit, down to the noise."""
    return current.chi2_per_sample > MISFIT and best.result.chi2_per_sample < WHOLE[0] and best.explained_share > WHOLE[1]


def _decides(current, best, excess) -> bool:
    """Whether a further effect makes a clear misfit vanish: then check recordings need not show it, for what they ask of a
    density that the others did not visit may outweigh it."""
    met = best.result.chi2_per_sample < MISFIT
    return current.chi2_per_sample > FAR_BESIDE and met and best.drop > DECISIVE * excess


def _predicts_worse(before, after, foretell) -> bool:
    """Do the check recordings say against a further effect?"""
    says = foretell.says_for(after, before)
    if says is not None:
        return says < 0
    rows = check_errors(before.actuator, after.actuator, foretell.recordings, before.bench)
    old, new = (sum((r[k] / (r["noise_rms"] or r["rms_before"])) ** 2 for r in rows) for k in ("rms_before", "rms_after"))
    return new > 1.02 * old


def _confirmed(before, after, foretell) -> float:
    """What the check recordings say for a further effect, as a fall of chi2; without end against it where that is next to nothing."""
    says = foretell.says_for(after, before)
    return says if says is not None and says > BIC_DROP else -np.inf


def _promises(base, result, candidates) -> bool:
    """Whether a further effect promises more than half of a misfit, and more than the form of those found leaves: then the
    density waits, for a finer one would take it up. It does not wait for what a rough one passes for."""
    least = max(HALF * excess_of(result), FORM_ERROR * (chi2_of(base) - chi2_of(result)))
    promised = max((c.z**2 for c in candidates if c.name not in LIKE_DENSITY), default=0.0)
    return result.chi2_per_sample > FAR_BESIDE and promised > least


def _of_two(task, best, left, good):
    """The best and the scores beside it; or a rival's, with which a further effect explains what the best leaves.

    One effect with shapes of its own imitates two others better than either of them alone; and where none takes most, the
    first to be found is seldom one of the two. Rivals of other directions are looked ahead from by their scores.
    """
    if best.result.chi2_per_sample < MISFIT:
        return best, left
    tried, ahead = [best], []
    near = MISFIT if best.explained_share > IMITATES else FAR_FROM_NOISE
    for rival in sorted((t for t in good if t is not best), key=lambda t: chi2_of(t.result)):
        if chi2_of(rival.result) > LEADS_WITHIN * chi2_of(best.result) or len(tried) > RIVALS_OF_TWO:
            break
        if any(abs(chi2_of(t.result) / chi2_of(rival.result) - 1) < SAME or of_one_family(t, rival) for t in tried):
            continue
        tried.append(rival)
        scores = screened(rival.result, task.choices)
        first, excess = scores[0], excess_of(rival.result)
        promised = chi2_of(rival.result) - first.z**2
        if first.z**2 > HALF * excess and promised < chi2_of(best.result) - MIN_DROP:
            ahead.append((promised, rival, scores))
    for _, rival, scores in sorted(ahead, key=lambda row: row[0]):
        pair = to_the_end(task, rival.result, scores[0], excess_of(rival.result))
        cost = (rival.parameters + pair.parameters - best.parameters) * np.log(pair.result.data_count)
        met = pair.physical and pair.result.chi2_per_sample < near
        if met and chi2_of(pair.result) + cost < chi2_of(best.result) - max(BIC_DROP, HALF * excess_of(best.result)):
            return rival, scores
    return best, left


def _finer(task, current, best, good, excess, any_rest: bool = True, any_density: bool = True):
    """The best with another start memory and with a finer density where it still leaves something: both were chosen under
    the misfit of the base. Where it leaves much of which nothing further promises half, only the finest hats, which must take half
    of it. Where that changes them, the near rivals are tried again on the same. Returns the best, the trials beside it, and the
    task with what was chosen.

    Start memories that serve as well foretell other mean levels: the one that is tried first stands unless another is
    better by MIN_DROP.
    """
    found = chosen = task.choices
    free = dataclasses.replace(chosen, rest="auto")
    order = sum(rests_of(task.bench, free), ())
    any_rest = any_rest and len(order) > 1
    if any_rest and (chosen.rest != order[0] or best.result.chi2_per_sample > REST_SETTLED and not memory_is_told(best.result)):
        other = task.fit_on(best.result, best.result.actuator, choices=free)
        margin = MIN_DROP if order.index(other.choices.rest) < order.index(chosen.rest) else -MIN_DROP
        against = against_memory([(fit.problem, fit.solution) for fit in (other, best.result)])
        if against[0] < against[1] + margin:
            found = other.choices
    ahead, left, highest = best.result, best.result.chi2_per_sample, max(REFINE_BESIDE, LITTLE_LEFT * current.chi2_per_sample)
    if any_density and finer_hats(chosen) and FINER_FROM[0] < left < highest:
        found = task.fit(best.result.actuator, choices=found, spectra=best.result.spectra, refine=highest).choices
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
    if not again or chi2_of(ended.result) > chi2_of(best.result) + MIN_DROP:
        return best, good, before
    far = [t for t in good if t.name not in {a.name for a in again}]  # no rivals alone, but they may be beside a later effect
    return ended, [*again, *far], task
