"""Floors and data gates: what must be settled before any physics is named.

Noise (between the harmonics), solver (the residual on a finer grid), density (finer hats); and the problems of the
data themselves: drift, an unsettled start, periods that do not repeat.
"""

import numpy as np

from magjax.plausibility import si_unit
from magjax.words import sized

from .model import Predictor
from .record_level import drift_of
from .spectra import fit_lines

MISSED_SHARE = 0.4  # of a reading that changes sign in one recording alone: its rms about its mean that a fit of all misses
OWN_LINE = 0.5  # of a reading's largest line, that the one at the drive's frequency must be to tell a sign
NEXT = 3.0  # times the lowest frequency, up to which no reading may go with its drive where all signs are said to be swapped
SWAPPED, ONE_SWAPPED = 20.0, 1e4  # chi2/N from which a sign may be swapped: in all recordings, in one (loops may turn about zero M)
MOST = 0.8  # share of the recordings that must show it
RESTLESS = 5.0  # mean square of the first period between its harmonics over the white noise
COARSE = 20  # samples a period, below which harmonics fall between those that are read
FALLS = 1.5  # mean square of what two periods differ by, first half over second, from which it decays within two periods or so
HALF_OF_IT, SIDEBANDS, LASTS = 0.5, 2.5, 2.0  # of what does not repeat, a tone with its sidebands (orders); its first third over its last
NO_DRIFT = 0.25  # share of the change from the first period to the last that a drift must leave for a transient


def solver_floor(problem, solution) -> float:
    """Rms change of the reading when the step is halved, unit of the reading."""
    fine = problem.predictors[1]
    grids = [d.shape[1] for d in fine.drives]
    twice = Predictor.build(problem.spectra, 2 * min(grids), fine.harmonics, fine.periods_of_each, fine.corners)
    change = (problem.passes.lines(solution.z, twice) - problem.passes.lines(solution.z, fine))[:, 1:]
    return float(np.sqrt(np.mean(2 * np.sum(np.abs(change) ** 2, axis=1))))


def data_problem(recordings, spectra, output) -> str | None:
    """What is wrong with the data themselves, in one sentence with the mend; None where nothing is."""
    problem = _unsettled(recordings, spectra, output)
    coarse = min(spectra, key=lambda s: s.samples / s.periods)
    if problem and coarse.samples / coarse.periods < COARSE and problem.startswith(coarse.name) and "drifts" not in problem:
        return (
            f"{coarse.name}: {coarse.samples / coarse.periods:.3g} samples a period are too few: what repeats and what does not cannot be "
            f"told apart; sample {COARSE} times a period at least, and so many times that periods end on a sample"
        )
    return problem


def _unsettled(recordings, spectra, output) -> str | None:
    """A recording, or most of them, that does not repeat, in words."""
    widest, unit = max(s.peak_to_peak for s in spectra), si_unit(output)
    for recording, s in zip(recordings, spectra, strict=True):
        if s.periods >= 2:
            y = _reading(recording, s, output)
            blocks = _by_period(s, y)
            floor = np.sqrt(2 * s.noise.white)
            first, later = _changes(blocks)
            sudden = first > 0.03 * s.peak_to_peak and first > 8 * floor and (first > 4 * later if s.periods > 2 else _falls(blocks))
            if sudden and _changes(_by_period(s, y - drift_of(s)[1]))[0] > NO_DRIFT * first:
                return _tone_beside(recording.name, s, y, unit) or (
                    f"{recording.name}: the first period differs from the last by {sized(unit, first)} rms and later ones do not: an unsettled "
                    "transient; cut the first periods or wait before recording"
                )
            moved = float(np.abs(blocks[-1].mean() - blocks[0].mean()))
            if moved > 0.05 * widest and moved > 8 * floor:
                return f"{recording.name}: the reading drifts by {sized(unit, moved)} through the record; let it warm up, or remove the drift first"
    recording, s = min(zip(recordings, spectra, strict=True), key=lambda pair: pair[1].samples * pair[1].dt)
    y = _reading(recording, s, output) - drift_of(s)[1]
    if s.periods >= 2 and (change := _changes(_by_period(s, y))[0]) > max(0.01 * s.peak_to_peak, 8 * np.sqrt(2 * s.noise.white)):
        return _tone_beside(recording.name, s, y, unit) or (
            f"{recording.name}: the periods do not repeat: the last differs from the first by {sized(unit, change)} rms within "
            f"{s.samples * s.dt * 1e3:.3g} ms, and no drift explains it; wait until the reading is settled, then record"
        )
    if (share := _restless(recordings, spectra, output)) is not None:
        return (
            f"the periods do not repeat: in most recordings the last differs from the first by {share:.1%} of the motion, and neither drift nor "
            "noise explains it; wait until the reading is settled, then record"
        )
    return None


def _restless(recordings, spectra, output) -> float | None:
    """Change from the first period to the last over the motion (median), where most recordings change and it is not their noise.

    A slow decay in every recording counts into the estimate of the noise; its first period still stands out of the white part.
    """
    changes, risen = [], []
    for recording, s in zip(recordings, spectra, strict=True):
        if s.periods >= 2:
            y = _reading(recording, s, output) - drift_of(s)[1]
            left = fit_lines(y, np.arange(s.samples) * s.dt * s.frequency, len(s.reading) - 1)[1]
            changes.append(_changes(_by_period(s, y))[0] / s.peak_to_peak)
            risen.append(np.mean(left[: int(s.samples / s.periods)] ** 2) / s.noise.white)
    if not changes or np.median(risen) < RESTLESS or np.mean(np.asarray(changes) > 0.01) < MOST:
        return None
    return float(np.median(changes))


def _reading(recording, s, output):
    """The samples that a spectrum was made of: the reading less a start that decays with the mechanics."""
    y = np.asarray(recording.channels[output])[: s.samples]
    return y if s.start is None else y - s.start


def _by_period(s, y):
    """The samples less what repeats, period by period, (periods, samples); periods need not divide the sampling."""
    step = int(s.samples / s.periods)
    cycles = np.arange(s.samples) * s.dt * s.frequency
    left = fit_lines(y, cycles, len(s.reading) - 1)[1]
    return np.stack([np.interp(k + np.arange(step) / step, cycles, left) for k in range(s.periods)])


def _changes(blocks):
    """Rms of the last period less the first, and less the one before it."""
    first = float(np.sqrt(np.mean((blocks[0] - blocks[-1]) ** 2)))
    return first, float(np.sqrt(np.mean((blocks[-2] - blocks[-1]) ** 2))) if len(blocks) > 2 else 0.0


def _tone_beside(name, s, y, unit) -> str | None:
    """That a tone which lasts stands between the harmonics, in words; None where that is not most of what does not repeat. Its
    sidebands within two of the drive's lines count with it: it may come and go with the stroke."""
    left = _by_period(s, y).ravel()
    power = np.abs(np.fft.rfft(left * np.hanning(len(left)))) ** 2
    order = np.arange(len(power)) / s.periods
    highest = order[np.argmax(power)]
    thirds = [np.mean(part**2) for part in np.array_split(left, 3)]
    if power[np.abs(order - highest) <= SIDEBANDS].sum() < HALF_OF_IT * power.sum() or thirds[0] > LASTS * thirds[2] or highest < SIDEBANDS:
        return None
    return (
        f"{name}: a tone near {highest * s.frequency:.4g} Hz that is no harmonic of the drive lasts through the record, "
        f"{sized(unit, float(np.std(left)))} rms: an interference, or a carrier folded down by the sampling; filter it out before the converter, "
        "or sample at another rate"
    )


def _falls(blocks) -> bool:
    """Whether what two periods differ by falls, as a transient does; a tone beside the drive's harmonics lasts."""
    halves = np.array_split((blocks[0] - blocks[1]) ** 2, 2)
    return bool(halves[0].mean() > FALLS * halves[1].mean())


def _has_sign(s) -> bool:
    """Whether the drive's own line is strong enough in a reading to say whether it goes with the drive or against it."""
    return len(s.reading) > 1 and abs(s.drive[1]) > 0 and abs(s.reading[1]) > OWN_LINE * np.abs(s.reading[1:]).max()


def swapped(spectra, fits=()) -> str | None:
    """That the sign of a channel is swapped, in words: in all recordings, by the slowest, or in one that no faster one bears out; of
    those in which the drive's own line says it, for about no M the strain goes by its square, at twice the drive's frequency.

    `fits`: the `RecordingFit` of each, where one alone may be: it must be missed by a part of itself, for about no field, where
    the strain goes by M^2, a reading may well move against the drive.
    """
    lags = [-float(np.angle(s.reading[1] / s.drive[1])) if _has_sign(s) else None for s in spectra]
    known = [(s.frequency, lag) for s, lag in zip(spectra, lags, strict=True) if lag is not None]
    slowest = min((f for f, _ in known), default=0.0)
    slow = [lag for f, lag in known if f <= 1.01 * slowest]
    with_it = [f for f, lag in known if f < NEXT * slowest and -0.1 * np.pi < lag < 0.5 * np.pi]  # where M is of the other sign
    if slow and all(abs(lag) > 0.75 * np.pi for lag in slow) and not with_it:
        return "the reading falls where the drive rises at the lowest frequency: the sign of a channel is swapped; set scale = -1 in [columns]"
    for s, lag, row in zip(spectra, lags, fits, strict=False):  # none, where one alone is not asked for
        if row.residual_rms < MISSED_SHARE * np.sqrt(2 * np.sum(np.abs(s.reading[1:]) ** 2)):
            continue
        # a reading lags, the more the faster; swapped it leads, or lags by half a turn
        faster = [other for f, other in known if f > s.frequency and 0 < other < 0.9 * np.pi]
        if lag is not None and faster and not -0.15 * np.pi < lag < max(faster) + 0.15 * np.pi:
            return f"the reading of {s.name} moves against that of the others: the sign of a channel is swapped in it; give it scale = -1, or leave it out"
    return None


def wrong_bench(result) -> str | None:
    """A bench file that cannot be this bench: swapped sign of the reading."""
    chi2n = result.chi2_per_sample
    return None if chi2n <= SWAPPED else swapped(result.spectra, () if chi2n <= ONE_SWAPPED else result.recordings)  # a fit that broke down too
