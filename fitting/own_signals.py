"""What the readings hold that no actuator makes: drift, heat and hum of a record, a sensor's zero, zeros and means of each recording.

Adopted before the effects, or in their place where these do not serve as well; `task`: a `Task`, `adopted`: what was taken out of
its recordings, each effect with its rivals.
"""

import dataclasses

import numpy as np

from magjax.words import sized

from .attribute import BIC_DROP, CLOSE, MIN_DROP, MISFIT, SETTLED_CHI2, TIE, WEAK_TIE, chi2_of, excess_of, settled, try_effect
from .diagnosis import SILENT_CHI2, Diagnosis, least_excess
from .finer import FINER_FROM
from .on_lines import heat_score, hum_score, offset_score, zeros_score
from .record_level import (
    by_heat,
    hum_between,
    hum_is_seen,
    hum_of,
    in_its_times,
    lone_drifts,
    pulsation_of,
    record_effects,
    remove_record_effect,
    score_of,
    without_lone_drifts,
    zeros_of,
)
from .rows import DRIFTS
from .screen import screened
from .setup import spectra_of
from .spectra import unlikeliness
from .verdict import HALF, Z_THRESHOLD

HUM_Z = 7.0  # what is no hum scored 5.3 at most, of 180 sets of recordings
DRIFT_Z = 6.0, 8.0  # no drift: 3.4; beside a drift that was taken out, what its form left scored 6.8
NEARLY = 0.9  # of the score of what is taken out, from which another is its rival
LASTING_Z = 5.0  # by the noise that is left, flicker that goes on below the records' length: 3.5 at most where nothing drifts, 5.6 at least where it does
FAR_ZERO = 3.0  # chi2/N from which a sensor's zero need not score highest: far from the first order others do
MOST_LIKELY = 3  # effects that are fitted where they promise as much as zeros of the recordings
NEARLY_ALL = 0.9  # of a misfit, that means must hold where the readings drift within the recordings, too
ALIKE = 0.1  # spread of zeros in units of their mean, below which they are one: a zero of the sensor's, and none that changes
MEANS_HOLD = 0.5  # of what is left beside a slow effect, that the means of the recordings must hold
MOST_OF_IT = 0.8  # of a misfit, that hum on harmonics, or a rod's breathing with the heat, must take
HEAT_PASSES, NOTHING_LEFT = 2, 2.0  # fits that find the rate of a pulsation, and z of what they may leave of it
HEAT_RATE = 0.5  # of the pulsation, in units of the drift's: what cools fast breathes and drifts no more
LIKE_DRIFT = 3.0  # the same up to which the drift speaks for the pulsation: it must take but half of a misfit then, if no effect scores as high


def drifts_of_one(recordings, spectra, bench):
    """The recordings without the drift that one of them alone shows, and what there is to say of it, a sentence each. Hum looks
    like a drift in records shorter than its period, and hides one in others: what drifts must do so beside it."""
    if bench.quasistatic or bench.output != "displacement":
        return recordings, []
    hum = hum_between(spectra)
    if hum.z > HUM_Z:
        spectra = spectra_of(remove_record_effect(recordings, hum, bench.output), bench)
    return without_lone_drifts(recordings, lone_drifts(spectra), bench.output)


def record_level(recordings, spectra, bench, choices):
    """Drift, heat and hum, scored between the harmonics: (adopted with their rivals, the recordings without them)."""
    adopted = []
    for _ in range(0 if bench.quasistatic or bench.output != "displacement" else 2):
        held = {a.name for a, _ in adopted} | ({"thermal_drift"} if bench.drive == "voltage" else set())  # the heat of a coil
        found = [e for e in record_effects(recordings, spectra) if e.name not in held]
        found = [e for e in found if e.name == "mains_hum" or _lasts(e, recordings, spectra, bench, choices)]
        best = next(iter(found), None)
        if best is None or abs(best.z) < (HUM_Z if best.name == "mains_hum" else DRIFT_Z[bool(adopted)]):
            break
        best = _leaves_least(best, found, recordings, bench, choices)
        without = remove_record_effect(recordings, best, bench.output)
        cleaned = spectra_of(without, bench, choices.harmonics)
        if best.name == "thermal_drift" and not best.shapes.get("own"):
            # by the noise that is left: what drifts adds to it
            known = [dataclasses.replace(s, noise=c.noise) for s, c in zip(spectra, cleaned, strict=True)]
            if better := in_its_times(best, recordings, known):
                best, found = better, [better, *(e for e in record_effects(recordings, known) if e.name not in held | {best.name})]
                without = remove_record_effect(recordings, best, bench.output)
                cleaned = spectra_of(without, bench, choices.harmonics)
        # one that warms through another node has more shapes than to be a rival of another
        rivals = [e for e in found if e.name != best.name and abs(e.z) > NEARLY * abs(best.z) and "taus" not in e.shapes]
        adopted.append((best, [e for e in rivals if _leaves_as_much(e, best, recordings, bench, choices)]))
        recordings, spectra = without, cleaned
    return adopted, recordings


def _left(effect, recordings, bench, choices) -> float:
    """Minus twice the logarithm of the likelihood of the noise that is left without a record-level effect."""
    spectra = spectra_of(remove_record_effect(recordings, effect, bench.output), bench, choices.harmonics)
    return 2 * unlikeliness(spectra, [s.noise for s in spectra])


def _leaves_least(best, found, recordings, bench, choices):
    """The best, or of drifts the other one where that leaves likelier noise: one that scores by a few records may make others worse."""
    others = [e for e in found if best.name in DRIFTS and e.name in set(DRIFTS) - {best.name} and abs(e.z) > DRIFT_Z[0]]
    least = _left(best, recordings, bench, choices) - BIC_DROP if others else -np.inf
    return next((e for e in others if _left(e, recordings, bench, choices) < least), best)


def _leaves_as_much(rival, best, recordings, bench, choices) -> bool:
    """Whether noise is about as likely without a rival of the best as without that, if one is a hum and the other drifts: each looks like
    the other, where its form is not asked."""
    if (rival.name in DRIFTS) == (best.name in DRIFTS):
        return True
    least = _left(best, recordings, bench, choices)
    return _left(rival, recordings, bench, choices) < least + (1 - NEARLY**2) * best.z**2


def _lasts(drift, recordings, spectra, bench, choices) -> bool:
    """Whether a drift scores by the noise that is left without it, too, of which flicker below the records' length looks like one."""
    if abs(drift.z) < DRIFT_Z[0]:
        return True  # too little anyway
    cleaned = spectra_of(remove_record_effect(recordings, drift, bench.output), bench, choices.harmonics)
    return score_of(drift, [dataclasses.replace(s, noise=c.noise) for s, c in zip(spectra, cleaned, strict=True)]) > LASTING_Z


def hum_on_harmonics(task, adopted, base, candidates=()):
    """Hum that falls on harmonics of the drive, where no repeat shows it: adopted if it scores above every effect and takes
    most of what `base` leaves. Returns the task without it, the effect with its rivals, and its fit; None elsewhere.
    """
    held, bench = any(e.name == "mains_hum" for e, _ in adopted), task.bench
    if held or bench.output != "displacement" or bench.quasistatic or not base.chi2_per_sample > SILENT_CHI2:
        return None
    excess = excess_of(base)
    z, tones = hum_score(base.problem, base.refined)
    if z**2 < max([Z_THRESHOLD**2, 0.5 * excess, *(c.z**2 for c in candidates)]) or not hum_is_seen(base.spectra, tones):
        return None
    effect = hum_of(base.spectra, z, tones)
    cleaned = task.on(recordings=tuple(remove_record_effect(task.recordings, effect, bench.output)))
    freed = cleaned.fit(base.actuator)
    if chi2_of(freed) > chi2_of(base) - MOST_OF_IT * excess:
        return None
    return cleaned, (effect, []), freed


def heat_on_harmonics(task, adopted, base, candidates=()):
    """Heat that shows between the harmonics as a drift pulses with the square of the current, too, and each recording begins as
    warm as it is: adopted if both, or the pulsation alone, take most of what `base` leaves, at no less than the drift's rate; or
    half of it at about that rate, where it scores above all `candidates`: something else is missing, too.
    Returns the task without them, all that was adopted, and its fit; None elsewhere.
    """
    bench, held = task.bench, {k for e, _ in adopted for k in ("zeros", "pulsation") if e.shapes.get(k)}
    if held or bench.output != "displacement" or bench.drive != "current" or bench.quasistatic:
        return None
    drifts = [_as_heat(e, rivals, base.spectra) for e, rivals in adopted]
    heat = next((e for e, _ in drifts if e.name == "thermal_drift"), None)
    if heat is None or not base.chi2_per_sample > SILENT_CHI2:
        return None
    excess = excess_of(base)
    highest = max((abs(c.z) for c in candidates), default=np.inf)
    for zeros in (False, True):
        score = heat_score(base.problem, base.refined, zeros)
        like_drift = HEAT_RATE < score.rate / heat.amplitude < LIKE_DRIFT and abs(score.z) > highest
        most, nearly = (HALF, HALF) if like_drift else (MOST_OF_IT, NEARLY_ALL)
        if abs(score.z) < Z_THRESHOLD or score.fall < most * excess or abs(score.rate) < HEAT_RATE * abs(heat.amplitude):
            continue
        cleaned, more, freed = _without_heat(task, base, score)
        if freed.chi2_per_sample < least_excess(freed) or chi2_of(freed) < chi2_of(base) - nearly * excess:
            return cleaned, [*drifts, *((e, []) for e in more)], freed
    return None


def _as_heat(effect, rivals, spectra):
    """A drift that was adopted, with its rivals, as that of a rod that warms, if it may be: alone. It may slow down, or turn,
    where a record begins warm, and then tells nothing by its rates."""
    heat = by_heat(effect, spectra) if effect.name == "zero_drift" and effect.shapes.get("own") else effect
    return (heat, []) if heat.name == "thermal_drift" else (effect, rivals)


def _without_heat(task, base, score):
    """The task without a pulsation and with free means, if there are zeros; what was taken out; the fit. The rate is found again."""
    free, rate = [], score.rate
    if len(score.zeros):
        free = zeros_of(base.spectra, score.z, score.zeros, score.zero_errors, ["thermal_drift"])
    for _ in range(HEAT_PASSES):
        more = [pulsation_of(base.spectra, score.z, rate, score.stderr), *free]
        recordings = task.recordings
        for effect in more:
            recordings = remove_record_effect(recordings, effect, task.bench.output)
        cleaned = task.on(recordings=tuple(recordings))
        freed = cleaned.fit(base.actuator)
        left = heat_score(freed.problem, freed.refined)
        if abs(left.z) < NOTHING_LEFT:
            break
        rate += left.rate
    return cleaned, more, freed


def own_zeros(task, adopted, base, candidates):
    """A zero that changes from recording to recording: adopted if it promises about as much as any effect, alone meets the
    noise, and the effects that promise as much do not serve as well. Beside a drift within the recordings, which goes on between
    them, it need only take nearly all. Returns the task with free means, the effect with its rivals, and its fit; None elsewhere.
    """
    held, bench = any(e.shapes.get("zeros") for e, _ in adopted), task.bench
    if held or bench.output != "displacement" or bench.quasistatic or not base.chi2_per_sample > least_excess(base):
        return None
    excess = excess_of(base)
    z, zeros, errors = zeros_score(base.problem, base.refined)
    likely = [c for c in candidates if abs(c.z) > CLOSE * z]
    if _of_one(zeros) or z**2 < max([Z_THRESHOLD**2, 0.5 * excess, *(c.z**2 * (1 - WEAK_TIE[0]) - TIE for c in candidates)]):
        return None
    effect, *rivals = zeros_of(base.spectra, z, zeros, errors, [e.name for e, _ in adopted])
    cleaned = task.on(recordings=tuple(remove_record_effect(task.recordings, effect, bench.output)))
    freed = cleaned.fit(base.actuator)
    drifts = any(e.name in DRIFTS for e, _ in adopted)
    met = freed.chi2_per_sample < least_excess(freed) or (drifts and chi2_of(freed) < chi2_of(base) - NEARLY_ALL * excess)
    if not met or chi2_of(freed) > chi2_of(base) - max(0.5 * excess, MIN_DROP):
        return None
    cost = chi2_of(freed) + len(zeros) * np.log(freed.data_count)
    if freed.choices != base.choices:  # on the same density: a rough one would speak against them
        task = task.on(choices=freed.choices)
        base = task.fit_on(freed, base.actuator, spectra=base.spectra)
        excess = excess_of(base)
    trials = (settled(task, base, try_effect(task, base, c, excess), excess) for c in likely[:MOST_LIKELY])
    if any(t.physical and chi2_of(t.result) + t.parameters * np.log(freed.data_count) < cost for t in trials):
        return None
    return cleaned, (effect, rivals), freed


def _of_one(zeros) -> bool:
    """Whether zeros of the recordings are one for all of them."""
    return float(np.std(zeros)) < ALIKE * abs(float(np.mean(zeros)))


def unsettled_means(task, adopted, slow, best, beside=()):
    """Means that an effect has brought as far in each recording as the drive had run before: set free where they hold most of
    what the fit with this `slow` effect leaves, and so serve better than the `best` of all. Returns the task with free means
    and the effect with its rivals; None elsewhere.

    Its law has one such number for all recordings; with the others wrong, another slow effect that bends the means serves better.
    Or means that have moved for reasons of their own, where `slow` is the best, of any kind, and they promise more than what
    scores `beside` it.
    """
    held, bench = any(e.shapes.get("zeros") for e, _ in adopted), task.bench
    if held or bench.output != "displacement" or bench.quasistatic or not best.chi2_per_sample > MISFIT:
        return None
    excess = excess_of(slow)
    z, zeros, errors = zeros_score(slow.problem, slow.refined)
    cost = len(zeros) * np.log(best.data_count) + BIC_DROP
    if _of_one(zeros):
        return None
    if z**2 < max([MEANS_HOLD * excess, *(c.z**2 + cost for c in beside)]) or chi2_of(slow) - z**2 + cost > chi2_of(best):
        return None
    task.say("with means of their own", slow.chi2_per_sample)
    effect, *rivals = zeros_of(slow.spectra, z, zeros, errors, [e.name for e, _ in adopted])
    cleaned = task.on(recordings=tuple(remove_record_effect(task.recordings, effect, bench.output)))
    freed = cleaned.fit(slow.actuator, start=slow, choices=slow.choices, refine=False)
    met = chi2_of(freed) < min(chi2_of(slow) - MEANS_HOLD * excess, chi2_of(best) - cost)
    return (cleaned, (effect, rivals)) if met else None


def needless_zeros(task, reached) -> bool:
    """Whether the recordings with their means are met by the effects that were found beside zeros of their own, nearly as well.

    `task`: before the means were set free."""
    if not reached.steps:
        return False
    current = reached.current
    task.say("with the means again", current.chi2_per_sample)
    again = task.fit(current.actuator, start=current, choices=current.choices, refine=False)
    cost = 2 * len(task.recordings) * np.log(again.data_count)
    return again.chi2_per_sample < SETTLED_CHI2 and chi2_of(again) < chi2_of(current) + cost


def sensor_zero(task, base, candidates):
    """A sensor whose zero is not the rod's rest: part of the base, if it scores above any effect and alone meets the noise.

    Returns the base, its candidates, the zero, m, or None, and the zero that would explain as much as the best effect, or None.
    """
    as_it_is, bench = (base, candidates, None, None), task.bench
    if bench.output != "displacement" or bench.drive == "voltage" or "sensor.offset" in bench.free:
        return as_it_is
    best, excess = max((c.z**2 for c in candidates), default=0.0), excess_of(base)
    score = offset_score(base.problem, base.refined) ** 2
    tied = max(TIE, WEAK_TIE[0] * best)
    needed = min(best - tied, 0.5 * excess) if base.chi2_per_sample > FAR_ZERO else best - tied
    if score < max(Z_THRESHOLD**2, needed):
        return as_it_is
    free = (*task.held, "sensor.offset")
    freed = task.fit_on(base, extra=free, choices=base.choices)
    if chi2_of(freed) > chi2_of(base) - max(0.5 * excess, MIN_DROP):
        return as_it_is
    if freed.chi2_per_sample > FINER_FROM[0]:  # the density was chosen under the misfit
        freed = task.fit(extra=free, spectra=base.spectra)
    if freed.chi2_per_sample > SILENT_CHI2:
        return as_it_is
    zero = freed.estimate("sensor.offset").value
    if score < best + tied and base.chi2_per_sample < FAR_ZERO:
        return base, candidates, None, zero
    return freed, screened(freed, task.choices), zero, None


def with_zero(found, zero, rival) -> Diagnosis:
    """The diagnosis with a word on the sensor's zero: adopted, or told of beside an effect that does as well."""
    if zero is not None:
        note = f" The sensor's zero is {sized('m', zero)} away from the rod's rest; free sensor.offset in the bench file."
    elif rival is not None and (found.effects or found.groups):
        note = f" A sensor's zero {sized('m', rival)} away from the rod's rest would explain as much; if it was not set there, free sensor.offset in the bench file."
    else:
        return found
    return dataclasses.replace(found, message=found.message + note)
