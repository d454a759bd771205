"""Attribution: the leaders of the screening are fitted for real and must earn their place.

Each fit goes on from the density of the base: from scratch it ends no better, and on a fine density far worse at times.
A candidate is credited with what it gains beyond the base fitted again from the same start (the placebo), must explain
its share of the excess misfit, and must have a physical sign. Rivals that end within a few units of chi2 of the best,
or whose directions coincide, cannot be told apart and form a group.
"""

import dataclasses

import numpy as np

from magjax.effects import CLASSES

from .finer import REFINE_BELOW, finest
from .screen import Candidate

LEADERS = 6  # families of directions that are tried
FAMILY = 0.85  # |cos| of two directions that makes a family
WORTH = 0.3  # of the highest score
MATES = 4
SETTLED_CHI2 = 1.12  # a leader that reaches this leaves only close rivals to try
CLOSE = 0.8  # share of the best score that makes a close rival
MIN_DROP = 25.0  # chi2; five standard deviations, beyond the placebo
BIC_DROP = 10.0
TIE = 9.0  # BIC; rivals nearer than this to the best are not told apart
NOTHING = 2.0  # standard errors within which an amplitude is none
FORM_ERROR = 0.005  # of what the effects found take: as little as that is left by their laws' form, and names nothing further
WEAK_TIE = (0.2, 25.0)  # nor rivals that meet the noise themselves within this share of the best's fall, up to so much or that form of the others
UNCONFIRMED_TIE = (0.3, 50.0)  # the same where check recordings are missed as far with the best as without
SAME_DIRECTION = 0.97
OUT_OF_REACH = 10.0  # times the largest typical amplitude: beyond it one law imitates another
DETAIL_SHARE = 0.3  # of the misfit that an effect takes where the details of its law are tried
AT_NOISE = 0.92  # chi2/N at which a fit with nothing missing ends
MISFIT = 1.3  # chi2/N from which the best is not the whole truth itself:
ROUGH_CHI2 = 3.0  # chi2/N that a rough density may leave where nothing scores
NO_CLEARER = 2.0  # times what the best leaves above the noise, that one which does the same to first order may leave beside a misfit
MISFIT_TIE = 0.1  # rivals within this share of what it leaves are not told apart, growing from none where the noise is met


@dataclasses.dataclass(frozen=True)
class Trial:
    """One candidate fitted: its fit, what it gained beyond the placebo, whether its sign is physical."""

    candidate: Candidate
    result: object
    drop: float
    bic_change: float
    physical: bool
    explained_share: float
    parameters: int = 0

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.candidate.name


def chi2_of(result) -> float:
    """Total chi2 of a fit."""
    return result.chi2_per_sample * result.data_count


def excess_of(result, at_noise: float = AT_NOISE) -> float:
    """What a fit leaves above the noise: chi2 beyond that of one with nothing missing, which uses up some of its data."""
    return chi2_of(result) - at_noise * result.data_count


# known rivals to first order whose score says little once the base has bent to the other: tried wherever that one is
LAGS = ("amplifier_lag", "sensor_lag", "transport_delay")
# friction and play act alike at their size, and a base that has bent to one scores either
# a strain linear in M has no score where the density makes all of its first order; what is left of it others of the same kind take up
# of eddy currents that diffuse a second path makes nearly all, and where R_eddy is free either takes its share
COMPANIONS = {
    **dict.fromkeys(LAGS, LAGS),
    **{"second_eddy_path": (*LAGS, "field_diffusion"), "field_diffusion": ("second_eddy_path",)},
    **{"coulomb_friction": ("backlash",), "backlash": ("coulomb_friction",)},
    **dict.fromkeys(("quartic_magnetostriction", "strain_hysteresis", "sensor_nonlinearity"), ("linear_strain",)),
}
# the density bends to them further than its tangent tells, and a rough one scores as they do
LIKE_DENSITY = ("mean_field", "reversible_magnetization", "accommodation")
FEEDBACKS = ("stress_feedback",)  # its column says little where the base has bent to it: tried wherever it scores
# thresholds, and a mean that follows M, act at their size as they do not next to none: tried where they score and no effect takes most
UNLIKE_NULL = ("backlash", "coulomb_friction", "accommodation")
STRUCTURES = ("eddy_currents",)  # their column at null says little: at their real size they change which relays switch


def leaders(candidates, count: int = LEADERS):
    """The candidates worth a fit, best first: the highest score of each family of like directions, and structures.

    Where much is amiss every candidate scores, and the highest ones are often rivals of one another: a family is tried by
    its first member, and the rest of it (`family`) once that has proved the best.
    """
    visible = [c for c in candidates if abs(c.z) > 3 and c.visibility > 1e-3]
    chosen = []
    for c in visible:
        if len(chosen) < count and abs(c.z) > WORTH * abs(visible[0].z) and not any(_alike(c, x) > FAMILY for x in chosen):
            chosen.append(c)
    if chosen:
        chosen += [c for c in candidates if c.name in STRUCTURES and c not in chosen]
    return chosen


def family(best: Candidate, candidates, tried) -> list[Candidate]:
    """Candidates not `tried` (names) that look like the best to first order, or score nearly as it does."""
    near = [c for c in candidates if c.name not in tried and abs(c.z) > 3 and c.visibility > 1e-3]
    like = [c for c in near if _alike(c, best) > FAMILY or abs(c.z) > CLOSE * abs(best.z)][:MATES]
    known = [c for c in candidates if c.name in COMPANIONS.get(best.name, ()) and c.name not in tried and c not in like]
    return known + like


def _alike(a: Candidate, b: Candidate) -> float:
    if a.direction is None or b.direction is None or len(a.direction) != len(b.direction):
        return 0.0
    return abs(float(a.direction @ b.direction))


def try_effect(task, base, candidate, excess, target: float = np.inf) -> Trial:
    """Fit base + effect, started at the screening's amplitude and from the density of the base.

    `task`: a `Task`; `target`: a chi2 that it must come near to be of use. The screening's amplitude goes with a move of all
    other parameters, which stand where the base had them: where the base hides most of the effect that start may be so
    far off that the fit ends worse than without it. Then it begins anew nearer to none, from where the misfit is no
    larger than the base's: of as many periods, for of fewer, where these have not settled, it is.
    """
    effect_class = CLASSES[candidate.name]
    info = effect_class.parameters()[effect_class.amplitude]
    reach = max(abs(t) for t in info.typical) if info.typical else 10 * info.scale
    amplitude = float(np.clip(candidate.amplitude, -reach, reach))
    effect = effect_class(**candidate.shapes).with_amplitude(
        amplitude if abs(amplitude) > 1e-12 * info.scale else 1e-3 * info.scale
    )
    actuator = base.actuator.with_effect(effect)
    if candidate.name in FEEDBACKS:  # the base's density has bent to do what it does: not from there
        result = task.fit(actuator, choices=base.choices, spectra=base.spectra, refine=False, target=target)
        if base.chi2_per_sample < MISFIT:  # later nothing is left that asks for further starts
            further = [task.fit_on(base, base.actuator.with_effect(e), target=target) for e in effect_class.elsewhere(base.actuator)]
            result = min(result, *further, key=finite_chi2)
    else:
        result = task.fit_on(base, actuator, target=target, patient=False)
        if not chi2_of(result) < chi2_of(base) and chi2_of(base) - candidate.z**2 < target:
            nearer = base.actuator.with_effect(effect.with_amplitude(amplitude * _no_farther(candidate, base)))
            settled_there = dataclasses.replace(task.choices, periods=base.choices.periods)
            again = task.fit_on(base, nearer, choices=settled_there, target=target, patient=False)
            result = min(result, again, key=finite_chi2)
    return credited(candidate, result, base, effect, excess)


def _no_farther(candidate, base) -> float:
    """Share of the screening's amplitude that alone, all else held, moves the residual by no more than the misfit."""
    alone = abs(candidate.z) / max(candidate.visibility, 1e-9)
    return min(0.3, float(np.sqrt(max(excess_of(base), MIN_DROP))) / max(alone, 1e-9))


def finite_chi2(result) -> float:
    """Total chi2 of a fit, infinite where it has failed."""
    return chi2_of(result) if np.isfinite(result.chi2_per_sample) else np.inf


def settled(task, base, trial, excess, target: float = np.inf) -> Trial:
    """The trial, gone on with where it ended far from its start, unsettled, and came near the `target`; then in detail."""
    result = trial.result
    if not result.converged and chi2_of(result) < target:
        result = task.fit_on(result, result.actuator, choices=result.choices, spectra=base.spectra, target=target)
        trial = credited(trial.candidate, result, base, result.actuator.effect(trial.name), excess)
    return _gone_on(task, base, trial, excess, _further_starts(base, trial), MISFIT, target)


def to_the_end(task, base, candidate, excess, target: float = np.inf):
    """A trial, settled; one that cannot come near the `target` ends early."""
    return settled(task, base, try_effect(task, base, candidate, excess, target), excess, target)


def in_detail(task, base, trial, excess) -> Trial:
    """The trial with the details of its effect's law free whatever it leaves, if these take enough more."""
    return _gone_on(task, base, trial, excess, _details(trial), 0.0)


def _gone_on(task, base, trial, excess, starts, above, target: float = np.inf) -> Trial:
    """The trial, or the best that other `starts` of its effect lead to, where it leaves a chi2/N `above` this and takes a part of the
    misfit, or they are of another form of its law and it leaves more than noise, and they take enough more. Those that cannot come
    near the `target` end early, but for another form: it begins so far off that its first steps promise nothing of where it ends."""
    best = trial
    for start, of in starts:
        result = best.result
        another = type(start) is not type(result.actuator.effect(trial.name))
        least = min(above, SETTLED_CHI2) if another else above
        if result.chi2_per_sample <= least or not (another or best.explained_share > DETAIL_SHARE):
            continue
        same = {"choices": result.choices, "spectra": base.spectra, "target": np.inf if another else target}
        finer = task.fit_on(of, of.actuator.with_effect(start), **same)
        if not finer.converged and chi2_of(finer) < target:
            finer = task.fit_on(finer, finer.actuator, **same)
        finer = credited(trial.candidate, finer, base, start, excess)
        best = finer if finer.bic_change < best.bic_change - BIC_DROP else best
    return best


def _details(trial):
    """The effect of a trial with the details of its law, and the fit to go on from."""
    detailed = trial.result.actuator.effect(trial.name).in_detail()
    return [(detailed, trial.result)] if detailed is not None else []


def _further_starts(base, trial):
    """Effects to begin a further fit with, each with the fit to go on from: with details, and from elsewhere."""
    effect = trial.result.actuator.effect(trial.name)
    return _details(trial) + [(other, base) for other in effect.elsewhere(base.actuator)]


def credited(candidate, result, base, effect, excess) -> Trial:
    """What a fit with a further effect is worth beside the base's."""
    if not np.isfinite(result.chi2_per_sample):
        return Trial(candidate, result, 0.0, np.inf, False, 0.0)
    drop = chi2_of(base) - chi2_of(result)
    itself = all(is_physical(e) and e.is_seen(highest_line(result)) for e in result.actuator.effects)
    number = len(effect.free_parameters())
    extra = number * np.log(result.data_count)
    tested = dataclasses.replace(candidate, achieved_chi2_drop=float(drop), bic_change=float(extra - drop))
    return Trial(tested, result, float(drop), float(extra - drop), bool(itself), float(drop / max(excess, 1e-9)), number)


def highest_line(result) -> float:
    """The highest frequency, Hz, of the lines that a fit meets."""
    return max((s.frequency * (len(s.reading) - 1) for s in result.spectra), default=np.inf)


def is_physical(effect) -> bool:
    """Whether an effect's amplitude has a sign and a size that it can have, and it is what it is named for; an amplitude that
    ends in a bound of its own may run on."""
    info, amplitude = effect.parameters()[effect.amplitude], float(getattr(effect, effect.amplitude))
    largest = OUT_OF_REACH * max(map(abs, info.typical)) if info.typical and np.isinf(info.high) else np.inf
    return (info.low < 0 or amplitude >= 0) and abs(amplitude) <= largest and effect.is_itself()


def taken_back(actuator) -> dict:
    """How late each of an actuator's lags is, s, by name, where there are several and one is below none: together they are one lag of
    another form; {} elsewhere."""
    late = {e.name: float(getattr(e, e.amplitude)) for e in actuator.effects if e.name in LAGS}
    return late if len(late) > 1 and min(late.values()) < 0 else {}


def is_nothing(result, name) -> bool:
    """Whether the amplitude of an effect of a fit is within its errors of none."""
    effect = result.actuator.effect(name)
    found = result.estimate(f"effects.{name}.{effect.amplitude}")
    return abs(found.value - effect.parameters()[effect.amplitude].null) <= NOTHING * (found.stderr or 0.0)


def rivals_of(best: Trial, trials, near=WEAK_TIE, others: float = 0.0) -> list[Trial]:
    """Trials that the data do not tell from the best, the best first; `near`: as `WEAK_TIE`; `others`: the fall of chi2 by the other effects.

    By BIC or by AIC, whichever sees them nearer: shapes are held by priors and cost less than BIC charges.
    """
    tied = [t for t in trials if t is not best and t.physical and tie_of(best, t, near, others)]
    return sorted([best, *tied], key=lambda t: t.bic_change)


def worth_ending(others: float) -> float:
    """How far behind the best a trial may end, chi2, for it to be worth its end: twice as far as a rival; `others`: as of `rivals_of`."""
    return max(2 * WEAK_TIE[1], FORM_ERROR * others)


def taken_by(steps, k: int) -> float:
    """The fall of chi2 by one of the effects that were adopted; `steps`: as of `search.Reached`."""
    after = steps[k + 1][3] if k + 1 < len(steps) else steps[k][0].result
    return chi2_of(steps[k][3]) - chi2_of(after)


def taken_beside(steps, index=None) -> float:
    """The same by all of them, but the one at an index."""
    return sum(taken_by(steps, k) for k in range(len(steps)) if k != index)


def tie_of(best: Trial, t: Trial, near=WEAK_TIE, others: float = 0.0) -> str:
    """Why the data do not tell a trial from the best, in words; "" where they do; `near`, `others`: as of `rivals_of`."""
    behind = min(t.bic_change - best.bic_change, best.drop - t.drop + 2 * (t.parameters - best.parameters))
    if behind < TIE:
        return f"its BIC or AIC comes within {TIE:g} of the best's"
    if t.result.chi2_per_sample < SETTLED_CHI2 and behind < min(near[0] * best.drop, max(near[1], FORM_ERROR * others)):
        met = f"it meets the noise too (chi2/N below {SETTLED_CHI2:g}), {behind:.0f} in chi2 behind the best"
        if behind < near[1]:
            return met + (", and with the best the check recordings are still missed about as far as without" if near != WEAK_TIE else "")
        return f"{met}: less than {FORM_ERROR:.1%} of what the other effects take, whose laws may differ by as much in form"
    left = best.result.chi2_per_sample
    share = MISFIT_TIE * min(max(left - SETTLED_CHI2, 0.0) / (MISFIT - SETTLED_CHI2), 1.0)
    if share and left_by_density(best.result):
        if behind < TIE * left:
            return f"what is left is a rough density's, and its BIC or AIC comes within {TIE:g} times that of the best's"
    elif behind < share * chi2_of(best.result):
        return f"the best leaves a misfit itself, and this is {behind:.0f} in chi2 behind it: less than {share:.1%} of that"
    elif left > MISFIT and _same(t, best) and excess_of(t.result) < NO_CLEARER * excess_of(best.result):
        return f"to first order it does the same to the reading, and beside a misfit that the best leaves too, it leaves {t.result.chi2_per_sample:.3g} in chi2/N"
    if behind < 2 * TIE and _same(t, best):
        return f"to first order it does the same to the reading, and its BIC or AIC comes within {2 * TIE:g} of the best's"
    return ""


def left_by_density(result) -> bool:
    """Whether a misfit is most likely what the finest hats do not follow: it acts as further noise, not as an effect that none names."""
    return finest(result.choices) and result.chi2_per_sample < REFINE_BELOW


def of_one_family(a: Trial, b: Trial) -> bool:
    """Whether two effects look alike to first order."""
    return _alike(a.candidate, b.candidate) > FAMILY


def _same(a: Trial, b: Trial) -> bool:
    return _alike(a.candidate, b.candidate) > SAME_DIRECTION


def confidence(best: Trial, trials) -> float:
    """Probability of the best among the tried by their BIC, times its share of the excess."""
    weights = [np.exp(-0.5 * min(max(t.bic_change - best.bic_change, -50.0), 700.0)) for t in trials if t.physical]
    share = np.clip(best.explained_share, 0.0, 1.0)
    return float(np.clip(share / max(sum(weights), 1.0), 0.0, 0.99))
