"""Recordings that are spoilt: a wrong scale, delay, zero, sign or clock of one file looks like physics in all of them.

One recording that the others contradict is asked for where the plain fit misses its noise: without the recording that it misses
most the others are fitted again, and where they then leave next to nothing, that recording is foretold from them. If one number of
its own (a factor, a time, a level) then makes up for nearly all by which it is missed, it is the file that is wrong; what only this
recording shows for its frequency or its amplitude asks for more than one number. And the clock of all is asked for where no drive
comes near the resonance that the bench states.
"""

import dataclasses

import numpy as np

from magjax.plausibility import si_unit
from magjax.words import sized

from .attribute import MISFIT
from .check import beyond_plane, prediction, predictions

FEWEST = 4  # recordings, of which three are left
STANDS_OUT = 2.0  # times the median, that it is missed by (chi2 per number)
NEXT_TO_NOTHING = 0.05  # of a misfit above the noise, that may be left: by the others without it, and by it once mended
SUSPECTS = 2  # recordings that are left out in turn
FAR = 20.0  # chi2/N from which it is asked for before all else
AWAY = 20.0  # times f0, or a part of it, that all drives are where their clock is in question
OUTSIDE = 0.01  # of the plane, that a mended drive may leave it by
UNITS = (1e-3, 1e3)  # factors of a column in another unit than it says
FACTORS = np.concatenate([np.geomspace(0.2, 5.0, 15), UNITS])  # of the drive and of the clock that are tried first
CLOSE = 1e-3  # of a factor, to which it is found
FINER = np.linspace(-1.0, 1.0, 21)  # of a step of the delays, about the best of them
NO_CHANGE = 0.02  # of a factor, below which it is none
AS_WELL = 2.0  # times what the best number leaves, and the noise, that another leaves that is named beside it
SWAPPED = 0.2  # from -1, that the factor of a swapped sign may be


@dataclasses.dataclass(frozen=True)
class Spoilt:
    """What may be wrong with the recordings, in words; `certain`: that it is, as one number that mends them shows."""

    told: str
    certain: bool


def spoilt(task, plain) -> Spoilt | None:
    """What speaks against the recordings of a task rather than for physics, where the `plain` fit misses them; None elsewhere."""
    return None if task.bench.quasistatic else (odd_one(task, plain) or clock_of_all(task, plain))


def odd_one(task, plain) -> Spoilt | None:
    """The one recording of a task that its `plain` fit meets badly on account of itself; None where there is none."""
    misses = np.array([r.chi2_per_sample for r in plain.recordings])
    missed = plain.chi2_per_sample > MISFIT and misses.max() > STANDS_OUT * np.median(misses)
    if len(misses) < FEWEST or not missed:
        return None
    doubtful = None
    for worst in np.argsort(-misses)[:SUSPECTS]:
        if misses[worst] < STANDS_OUT * np.median(misses):
            break
        recording = task.recordings[worst]
        others = tuple(r for k, r in enumerate(task.recordings) if k != worst)
        task.say(f"without {recording.name}", plain.chi2_per_sample)
        choices = dataclasses.replace(plain.choices, rest=task.choices.rest, touching=task.choices.touching)
        rest = task.on(recordings=others).fit(choices=choices, refine=False)
        if not rest.chi2_per_sample - 1 < NEXT_TO_NOTHING * (plain.chi2_per_sample - 1):
            continue
        name, why = recording.name, mended_by(rest.actuator, recording, task.bench)
        text = f"ithout {name} chi2/N of the others falls from {plain.chi2_per_sample:.3g} to {rest.chi2_per_sample:.2f}"
        if why:
            return Spoilt(f"{name} contradicts the others: {why}; correct it or leave it out (w{text})", True)
        doubtful = doubtful or Spoilt(f"W{text}: it alone reaches what is missing, or it is spoilt; look at it first", False)
    return doubtful


def clock_of_all(task, plain) -> Spoilt | None:
    """That the times of all recordings are in another unit than they say, in words: where the mechanics tells, asked of drives that
    are all far slower than it, or far faster, and that a clock of the other unit serves far better."""
    f0 = float(task.bench.constants.get("mechanics.f0", 0.0))
    frequencies = np.array([s.frequency for s in plain.spectra])
    if not f0 or not (max(frequencies) < f0 / AWAY or min(frequencies) > f0 * AWAY):
        return None
    factor = min(UNITS) if max(frequencies) < f0 else max(UNITS)
    task.say("in another unit of time", plain.chi2_per_sample)
    rest = task.on(recordings=tuple(_clocked(r, factor, task.bench) for r in task.recordings)).fit(refine=False)
    if not rest.chi2_per_sample - 1 < NEXT_TO_NOTHING * (plain.chi2_per_sample - 1):
        return None
    unit, name = ("1000 times", "time_ms") if factor < 1 else ("a thousandth of", "time_s, in seconds")
    return Spoilt(
        f"the times of all recordings are {unit} what their readings ask for: name the column {name} "
        f"(chi2/N falls from {plain.chi2_per_sample:.3g} to {rest.chi2_per_sample:.2f})",
        True,
    )


def mended_by(actuator, recording, bench) -> str | None:
    """The one number that makes up for nearly all by which an actuator misses a recording, in words; None where none does."""
    drive, unit = bench.drive, si_unit(bench.output)
    predicted, measured, noise = prediction(actuator, recording, bench)
    left = np.mean((predicted - measured) ** 2) - noise**2
    found = []  # (what is missed yet, words)
    if beyond_plane(actuator, recording, bench) < OUTSIDE:
        gain = float(predicted @ measured) / float(predicted @ predicted)
        text = f"is {gain:.3g} times what they make of it: check the column's scale"
        text = "moves against what they make of it: the sign of a channel is swapped" if abs(gain + 1) < SWAPPED else text
        found.append((gain * predicted - measured, f"its reading {text}"))
        level = float(np.mean(measured - predicted))
        found.append((predicted + level - measured, f"its reading lies {sized(unit, level)} from where they put it: its zero has moved"))
        late, shifted = _delayed(predicted, measured, recording)
        text = f"its reading comes {abs(late) * 1e3:.3g} ms {'later' if late > 0 else 'earlier'} than they make it"
        found.append((shifted - measured, f"{text}: align its columns"))
    for changed, text in (
        (_driven, "its {drive} is {times} times what its reading asks for: check the column's unit and scale"),
        (_clocked, "its times are {times} times what its reading asks for: check the column's unit"),
    ):
        for factor, miss in _by_factor(actuator, recording, bench, changed):
            found.append((miss, text.format(drive=drive, times=_in_words(1 / factor))))
    remains = sorted((float(np.mean(np.square(miss))) - noise**2, words) for miss, words in found)
    least = max(remains[0][0], 0.0) if remains else 0.0
    return ", or ".join(words for x, words in remains if x < min(NEXT_TO_NOTHING * left, AS_WELL * least + noise**2)) or None


def _in_words(factor: float) -> str:
    """A factor; of units, where it is about one."""
    return next((f"{u:g}" for u in UNITS if abs(np.log(factor / u)) < NO_CHANGE), f"{factor:.3g}")


def _delayed(predicted, measured, recording):
    """The delay that brings a prediction nearest to the reading, s, and the prediction so delayed."""
    count, dt, f = len(predicted), recording.dt, recording.frequency()
    level = predicted.mean()
    lines, w = np.fft.rfft(predicted - level), 2j * np.pi * np.fft.rfftfreq(count, dt)
    period = 1 / f
    delays, step = np.linspace(-0.5, 0.5, 201) * period, period / 200
    for _ in range(3):
        shifted = level + np.fft.irfft(lines * np.exp(-w * delays[:, None]), count)
        best = int(np.argmin(np.mean((shifted - measured) ** 2, axis=1)))
        late, there = float(delays[best]), shifted[best]
        delays, step = late + step * FINER, step / 10
    return late, there


def _by_factor(actuator, recording, bench, changed):
    """Nearest of the recordings that are `changed` by a factor: [(factor, what is missed)], none where that is the recording itself."""
    from scipy.optimize import minimize_scalar

    tried = [changed(recording, k, bench) for k in FACTORS]
    inside = [beyond_plane(actuator, r, bench) < OUTSIDE for r in tried]
    if not any(inside):
        return []
    rows = predictions(actuator, [r if fits else recording for r, fits in zip(tried, inside, strict=True)], bench)
    misses = [np.mean((p - y) ** 2) if fits else np.inf for (p, y, _), fits in zip(rows, inside, strict=True)]
    best, step = FACTORS[int(np.argmin(misses))], np.log(FACTORS[1] / FACTORS[0])

    def missed(logarithm):
        there = changed(recording, float(np.exp(logarithm)), bench)
        if beyond_plane(actuator, there, bench) >= OUTSIDE:
            return np.full(2, 1e3 * np.ptp(recording.channels[bench.output]))
        predicted, measured, _ = prediction(actuator, there, bench)
        return predicted - measured

    about = np.log(best) + np.array([-step, step])
    found = minimize_scalar(lambda x: np.mean(missed(x) ** 2), bounds=about, method="bounded", options={"xatol": CLOSE, "maxiter": 30})
    return [] if abs(found.x) < NO_CHANGE else [(float(np.exp(found.x)), missed(found.x))]


def _driven(recording, factor, bench):
    """The recording with its drive times a factor."""
    channels = {**recording.channels, bench.drive: factor * np.asarray(recording.channels[bench.drive], float)}
    return dataclasses.replace(recording, channels=channels)


def _clocked(recording, factor, bench):
    """The recording with its times times a factor."""
    return dataclasses.replace(recording, time=factor * np.asarray(recording.time))
