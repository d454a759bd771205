"""The search: leaders of the screening are fitted for real, the best is adopted while it earns its place, and screened again.

Forward here, round by round, with what lets an effect in; the fits of a round are in `trials`, what is settled before an effect is
adopted in `adoption`, and what was adopted once more, beside those that came later, in `exchange`.
"""

import dataclasses

import numpy as np

from .adoption import FAR_BESIDE, of_two, promises, refitted
from .attribute import (
    BIC_DROP,
    FEEDBACKS,
    FORM_ERROR,
    MIN_DROP,
    MISFIT,
    chi2_of,
    excess_of,
    leaders,
    rivals_of,
    taken_back,
    taken_beside,
    taken_by,
    to_the_end,
    worth_ending,
)
from .check import check_errors
from .diagnosis import SILENT_CHI2
from .exchange import MOST_RIVALS, backward, both_found, commuted, exchange
from .finer import finest
from .foretold import Foreteller
from .form import FILTERS, filter_takes
from .rows import SLOW
from .screen import screened
from .task import Late, periods_from
from .together import let_go, together
from .trials import try_all
from .verdict import FAR_FROM_NOISE, HALF, Z_THRESHOLD

MAX_EFFECTS = 3
HOPELESS = 2.0  # times what a repair may leave, after two effects
LEAST_SHARE = 0.3  # of what the first effects leave above the noise, that a further one must take
BEYOND_PROMISE = 3.0  # times what it promises to first order, that an effect may take
OF_FORM = 0.02  # as FORM_ERROR, for what takes less than half of a misfit and leaves one
BEYOND_FILTER = 0.25  # of what a further effect takes, that any filter of the reading leaves where it is not the form of one
WHOLE = 1.0, 0.9  # chi2/N and share of a misfit, at which what takes as little as FORM_ERROR is named: another law seldom has just their form
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
    `exchanged`: the fit whose effects were tried for rivals in their places already; `hidden`: names of effects adopted though nothing scored, for what check recordings say;
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
    exchanged: object = None
    hidden: tuple = ()
    late: bool = False
    partial: bool = False

    def adopt(self, best, good):
        """Go on from a trial, beside the others that earned their place."""
        self.steps.append((best, rivals_of(best, good, others=taken_beside(self.steps)), good, self.current))
        self.current, self.under_way = best.result, {}


def search(task, base, candidates, check=(), ends=lambda current: False, free_means=lambda fit, best, beside=(): False) -> Reached:
    """Forward: fit the leaders, adopt the best while it earns its place; then screen again. `task`: a `Task`, of what
    `base` was fitted to; `ends(fit)`: whether the fit with an effect that was adopted makes the rest of the search needless;
    `free_means(fit, best)`: the same of that with a slow effect, whose means are not settled, beside the best; `free_means(best,
    best, scores)`: of the best, beside which means promise more than what scores. A timed task's search ends with what it has:
    the best that was fitted in a round under way, where the round would not have refused it."""
    state = Reached(base, [], {}, foretell=Foreteller(check, base))
    scored = {c.name: c for c in candidates}
    any_rest = task.choices.rest == "auto"  # that of the base was chosen under its misfit
    task = task.on(choices=dataclasses.replace(base.choices, periods=periods_from(base)))  # its density may be finer than the default: rivals get the same
    try:
        task, made_up, needless = _forward(task, base, state, candidates, any_rest, check, ends, free_means)
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
        if state.current is not state.exchanged and exchange(task, state, check) and not state.form:
            backward(task, state, last_too=True)
        if commuted(task, state, scored.get("sensor_lag")):
            exchange(task, state, check)
    if state.steps and state.current is not state.steps[-1][0].result:
        ends(state.current)


def _forward(task, base, state, candidates, any_rest, check, ends, free_means):
    """The rounds, into the `state`; `any_rest`: whether start memories beside the base's may be tried. Returns the task on the density
    that was chosen beside the effects, the candidate of `state.form`, and whether the rest of the search is needless."""
    made_up = None
    for _round in range(MAX_EFFECTS):
        if len(state.steps) > 1:  # a wrong pair leaves what a third would be tried for
            candidates = _of_another_pair(task, base, state, candidates, check)
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
        trials = try_all(task, state.current, top, candidates, excess, state.under_way, worth_ending(taken_beside(state.steps)))
        state.under_way.update((t.name, t) for t in trials)
        state.tried = {t.name: t.candidate for t in trials} | state.tried  # the first time beside the plain fit
        good, best = _best_of(trials, hidden)
        if not hidden and (left := _in_place_of_unphysical(task, base, state, trials, best)):
            candidates = left
            continue
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
        if _another_pair_at_hand(task, state, best, good, check):
            best = state.steps[-1][0]
            candidates = screened(state.current, task.choices)
            if ends(state.current) or best.name not in SLOW and free_means(state.current, state.current, candidates):
                return task, made_up, True
            continue
        left = screened(best.result, task.choices)
        if best.name not in SLOW and free_means(best.result, best.result, left):
            return task, made_up, True
        if not state.steps and not promises(base, best.result, left):
            best, left = of_two(task, best, left, good, means=lambda fit, scores, of=best.result: free_means(fit, of, scores))
            if best is None:
                return task, made_up, True
        found, good, task = refitted(task, state.current, best, good, excess, any_rest, not promises(base, best.result, left))
        candidates = left if found.result is best.result else screened(found.result, task.choices)
        state.adopt(found, good)
        state.hidden += (found.name,) if hidden else ()
        let_go(found.result.actuator)
        if ends(state.current):
            return task, made_up, True
    return task, made_up, False


def _another_pair_at_hand(task, state, best, good, check) -> bool:
    """Whether rivals serve better together than those found and a second one that leaves a misfit, and are adopted in their place: asked
    before means of their own and finer densities are tried, which would take up what a wrong pair leaves."""
    if len(state.steps) != 1 or not MISFIT < best.result.chi2_per_sample < FAR_FROM_NOISE:
        return False
    steps, current = list(state.steps), state.current
    state.adopt(best, good)
    changed = exchange(task, state, check)
    state.exchanged = state.current
    if not changed:
        state.steps, state.current = steps, current
    return changed


def _of_another_pair(task, base, state, candidates, check) -> list:
    """The scores beside the effects found: two that leave a misfit are exchanged for rivals where these leave less. Far from the noise
    the first one gives way to a rival with which one of its own leaders comes nearer, and the next round finds that one."""
    if state.current is state.exchanged:
        return candidates
    if MISFIT < state.current.chi2_per_sample < FAR_FROM_NOISE:
        changed = exchange(task, state, check)
        state.exchanged = state.current
        return screened(state.current, task.choices) if changed else candidates
    if state.current.chi2_per_sample < FAR_FROM_NOISE:
        return candidates
    first, _, good, _ = state.steps[0]
    density = first.result.choices.knots, first.result.choices.cells
    good = [t for t in good if (t.result.choices.knots, t.result.choices.cells) == density]  # the others would be credited with a finer one
    other, left = of_two(task, first, candidates, good, state.current)
    if other is first:
        return candidates
    state.steps, state.current = [], base
    state.adopt(other, good)
    return left


def _in_place_of_unphysical(task, base, state, trials, best) -> list:
    """The scores beside a rival of the one effect found, in its place, where that and a further one are unphysical together and take
    more than it and the `best`, if there is any: it stood for two, and the rival and that one serve better. [] elsewhere."""
    worth = (best.bic_change if best else 0.0) - BIC_DROP
    wrong = [t for t in trials if not t.physical and t.drop > MIN_DROP and t.bic_change < worth]
    if len(state.steps) != 1 or not wrong:
        return []
    first, _, good, _ = state.steps[0]
    second = min(wrong, key=lambda t: t.bic_change)
    least, of_one = chi2_of(state.current) - BIC_DROP, np.log(base.data_count)
    rivals = sorted((t for t in good if t.name not in (first.name, second.name)), key=lambda t: t.bic_change)[:MOST_RIVALS]

    def beside(t):
        return lambda say: to_the_end(task.on(progress=say), t.result, second.candidate, excess_of(t.result), least)

    pairs = zip(rivals, together([beside(t) for t in rivals], task.progress), strict=True)
    serving = [(chi2_of(pair.result) + (t.parameters + pair.parameters - first.parameters) * of_one, t) for t, pair in pairs if pair.physical]
    ahead, other = min(serving, key=lambda row: row[0], default=(np.inf, None))
    if not ahead < least:
        return []
    state.steps, state.current = [], base
    state.adopt(other, good)
    return screened(other.result, task.choices)


def _best_of(trials, hidden: bool = False):
    """The trials that take enough for their parameters and are physical, and the best of them, or None; of `hidden` ones, for
    which check recordings must speak, any that take more than they do on nulls, the best of which must be a feedback: others score."""
    least, worth = (HIDDEN_DROP, np.inf) if hidden else (MIN_DROP, -BIC_DROP)
    good = [t for t in trials if t.physical and t.drop > least and t.bic_change < worth]
    best = min(good, key=lambda t: t.bic_change + (0 if t.result.converged else 5), default=None)
    return good, None if hidden and best and best.name not in FEEDBACKS else best


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
    """Whether a further effect takes as little as the form of the laws of those found leaves, or takes back part of a lag."""
    if _takes_back(state, best):
        return True
    half = best.result.chi2_per_sample < MISFIT or best.explained_share > HALF
    least = FORM_ERROR if half else OF_FORM
    little = best.drop < least * (chi2_of(base) - chi2_of(state.current)) and not _whole(state.current, best)
    return little and not (best.explained_share > HALF and state.current.chi2_per_sample > MISFIT and _no_filters_form(state, best, least))


def _no_filters_form(state, best, least) -> bool:
    """Whether a further effect takes what no form of the laws found makes: those that take enough to have such a form are filters of the
    reading, and any other filter leaves a good part of what it takes."""
    bent = sum(taken_by(state.steps, k) for k, (found, *_) in enumerate(state.steps) if found.name not in FILTERS)
    if not state.steps or best.name in FILTERS or best.drop < least * bent:
        return False
    return excess_of(state.current) - filter_takes(state.current) > BEYOND_FILTER * best.drop


def _takes_back(state, best) -> bool:
    """Whether a further effect and a lag that was found are one lag of another form."""
    late = taken_back(best.result.actuator)
    return best.name in late and any(step[0].name in late for step in state.steps)


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
