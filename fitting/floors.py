"""Floors and data gates: what must be settled before any physics is named.

Noise (between the harmonics), solver (the residual on a finer grid), density (finer hats); and the problems of the
data themselves: drift, an unsettled start, periods that do not repeat.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from .model import Predictor, predicted_lines
from .spectra import fit_lines, reduce_recording, with_noise

MAINS = (50.0, 60.0)
HUM_TONES = 3
RESTLESS = 5.0  # mean square of the first period between its harmonics over the white noise
NO_DRIFT = 0.25  # share of the change from the first period to the last that a drift must leave for a transient
OWN_GAIN, OWN_SHARE = 12.0, 0.8  # fall of chi2 by a drift of one record by itself, and the share of records that must show it


@dataclasses.dataclass(frozen=True)
class RecordEffect:
    """A record-level effect: amplitude common to the recordings with its score; `columns`: per recording."""

    name: str
    z: float
    amplitude: float
    stderr: float
    shapes: dict
    columns: tuple = dataclasses.field(repr=False, default=())


def solver_floor(problem, solution) -> float:
    """Rms change of the reading when the step is halved, unit of the reading."""
    fine = problem.predictors[1]
    grids = [d.shape[1] for d in fine.drives]
    actuator = problem.layout.actuator(problem.template, jnp.asarray(solution.z))
    twice = Predictor.build(problem.spectra, 2 * min(grids), fine.harmonics, fine.periods, fine.corners)
    change = np.asarray(predicted_lines(twice, actuator) - predicted_lines(fine, actuator))[:, 1:]
    return float(np.sqrt(np.mean(2 * np.sum(np.abs(change) ** 2, axis=1))))


def record_columns(recordings, spectra):
    """(name, shapes, column per recording) of record-level effects at unit amplitude."""
    rows = []
    times = [s.dt * np.arange(s.samples) for s in spectra]
    rows.append(("zero_drift", {}, [t for t in times]))
    for tau in (0.3, 3.0, 30.0):
        heat = []
        for recording, t in zip(recordings, times, strict=True):
            drive = np.asarray(recording.channels[recording.drive])
            heat.append(np.mean(drive**2) * tau * (1 - np.exp(-t / tau)))
        rows.append(("thermal_drift", {"tau": tau}, heat))
    return rows


def record_effects(recordings, spectra) -> list[RecordEffect]:
    """Drift, heat and hum scored on what the harmonics leave, best first."""
    found = {}
    for name, shapes, columns in record_columns(recordings, spectra):
        top, bottom = 0.0, 0.0
        for s, column in zip(spectra, columns, strict=True):
            weight, r, c = _between(s, column)
            top += float(np.sum(weight * (np.conj(c) * r).real))
            bottom += float(np.sum(weight * np.abs(c) ** 2))
        z, amplitude = top / np.sqrt(bottom), top / bottom
        if name not in found or abs(z) > abs(found[name].z):
            found[name] = RecordEffect(name, float(z), float(amplitude), float(1 / np.sqrt(bottom)), shapes, tuple(columns))
    if own := _own_drifts(spectra, found["zero_drift"].z):
        found["zero_drift"] = own
    for f in MAINS:
        z, tones, fits = _hum(spectra, f)
        if "mains_hum" not in found or z > found["mains_hum"].z:
            error = tones[0][1] / max(z, 1.0)
            found["mains_hum"] = RecordEffect(
                "mains_hum", float(z), tones[0][1], float(error), {"f": f, "tones": tones}, tuple(fits)
            )
    return sorted(found.values(), key=lambda e: -abs(e.z))


def drift_of(s):
    """The drift of one record by itself, straight and by the root of time, from zero at its start: (fall of chi2, samples)."""
    t = s.dt * np.arange(s.samples)
    parts = [t / t[-1], np.sqrt(t / t[-1])]
    best, gain = _combination([_between(s, p) for p in parts])
    return gain, sum(x * p for x, p in zip(best, parts, strict=True))


def _combination(reduced):
    """Amplitudes of columns of one record, as `_between` gives them, by least squares, and the fall of chi2."""
    G = np.array([[np.sum(a[0] * (np.conj(a[2]) * b[2]).real) for b in reduced] for a in reduced])
    g = np.array([np.sum(a[0] * (np.conj(a[2]) * a[1]).real) for a in reduced])
    best = np.linalg.solve(G + 1e-9 * np.trace(G) * np.eye(len(G)), g)
    return best, float(best @ g)


def _own_drifts(spectra, common: float) -> RecordEffect | None:
    """Drift of each record by itself, where that serves better (BIC) than the `common` rate, scored by z; None elsewhere."""
    gains, fits = zip(*(drift_of(s) for s in spectra), strict=True)
    extra, count = 2 * len(spectra), sum(s.samples for s in spectra)
    shown = np.mean(np.asarray(gains) > OWN_GAIN)  # a hum looks like a drift in short records only
    if shown < OWN_SHARE or sum(gains) - common**2 < extra * np.log(count):
        return None
    ends = np.array([f[-1] / (s.dt * s.samples) for f, s in zip(fits, spectra, strict=True)])
    rate = float(np.median(ends))
    z = float(np.sqrt(max(sum(gains) - extra, 0.0)))
    return RecordEffect("zero_drift", z, rate, float(np.std(ends) / np.sqrt(len(ends))), {"own": True}, fits)


def _hum(spectra, mains):
    """Hum of one mains frequency and its first harmonics, a phase of its own in each record: (z, tones, fits).

    `tones`: (frequency, largest amplitude over the records) of each; a tone that falls on a harmonic of the drive cannot be
    told from the reading there, and a record shorter than two of its periods tells no tone from slow noise: it takes no
    part in the score.
    """
    longest = max(s.samples * s.dt for s in spectra)
    frequencies = [k * mains for k in range(1, HUM_TONES + 1)]
    gain, number, power, fits = 0.0, 0, np.zeros(HUM_TONES), []
    for s in spectra:
        t = s.dt * np.arange(s.samples)
        parts, kinds = [], []
        for k, f in enumerate(frequencies):
            pair = [np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)]
            reduced = [_between(s, p) for p in pair]
            seen = sum(np.sum(np.abs(c) ** 2) for _, _, c in reduced) / sum(np.sum(np.abs(np.fft.rfft(p)) ** 2) for p in pair)
            if f < 0.45 / s.dt and seen > 0.05:
                parts += list(zip(pair, reduced, strict=True))
                kinds += [k, k]
        if not parts:
            fits.append(np.zeros(s.samples))
            continue
        best, fall = _combination([reduced for _, reduced in parts])
        if s.samples * s.dt >= min(2 / mains, longest * 0.999):
            gain += fall
            number += len(parts)
        for k in set(kinds):
            power[k] = max(power[k], float(np.linalg.norm(best[np.asarray(kinds) == k])))
        fits.append(sum(x * p for x, (p, _) in zip(best, parts, strict=True)))
    z = np.sqrt(max(gain - number, 0.0))  # of the same scale as one column's score
    return z, tuple((f, float(p)) for f, p in zip(frequencies, power, strict=True)), fits


def _between(s, column):
    """Weights, residue and column in the frequency domain, both without the harmonics."""
    phases = np.arange(s.samples) * s.dt * s.frequency
    left = fit_lines(np.asarray(column, float), phases, len(s.reading) - 1)[1]
    f = np.fft.rfftfreq(s.samples, s.dt)
    weight = 2.0 / (s.samples * s.noise.density(np.maximum(f, f[1])))
    weight[0] = 0.0
    return weight, np.fft.rfft(s.residue), np.fft.rfft(left)


def remove_record_effect(recordings, effect, output):
    """The recordings with a record-level signal taken out of the reading."""
    from magjax.recording import Recording

    cleaned = []
    for recording, column in zip(recordings, effect.columns, strict=True):
        signal = np.zeros(len(recording.time))
        scale = 1.0 if effect.name == "mains_hum" or effect.shapes.get("own") else effect.amplitude
        signal[: len(column)] = scale * column
        if len(column) < len(signal):
            signal[len(column) :] = signal[len(column) - 1]
        channels = {**recording.channels, output: recording.channels[output] - signal}
        origin = recording.origin
        if effect.name == "mains_hum":
            origin = {**origin, "hum": effect.shapes["tones"]}
        elif effect.shapes.get("own"):
            origin = {**origin, "drift": float(np.abs(column).max())}
        cleaned.append(Recording(recording.time, channels, recording.noise, origin, recording.name))
    return cleaned


def remove_from_checks(recordings, adopted, bench):
    """Check recordings without the record-level signals that were `adopted` from the others; each record's own drift and
    hum are found between its own harmonics. Recordings that do not repeat come back as they are."""
    cleaned = []
    for recording in recordings:
        for effect in adopted if recording.frequency() is not None else ():
            spectra = with_noise([reduce_recording(recording, bench.drive, bench.output, columns=bench.columns)])
            if effect.name == "mains_hum":
                columns = tuple(_hum(spectra, effect.shapes["f"])[2])
            elif effect.shapes.get("own"):
                columns = (drift_of(spectra[0])[1],)
            else:
                same = [c for n, shapes, c in record_columns([recording], spectra) if (n, shapes) == (effect.name, effect.shapes)]
                columns = tuple(same[0])
            recording = remove_record_effect([recording], dataclasses.replace(effect, columns=columns), bench.output)[0]
        cleaned.append(recording)
    return cleaned


def data_problem(recordings, spectra, output) -> str | None:
    """What is wrong with the data themselves, in one sentence with the mend; None where nothing is."""
    widest = max(s.peak_to_peak for s in spectra)
    for recording, s in zip(recordings, spectra, strict=True):
        if s.periods >= 2:
            y = _reading(recording, s, output)
            blocks = _by_period(s, y)
            floor = np.sqrt(2 * s.noise.white)
            first, later = _changes(blocks)
            sudden = first > 0.03 * s.peak_to_peak and first > 8 * floor and first > 4 * later
            if sudden and _changes(_by_period(s, y - drift_of(s)[1]))[0] > NO_DRIFT * first:
                return (
                    f"{recording.name}: the first period differs from the last by {first:.3g} rms and later ones do not: an unsettled "
                    "transient; cut the first periods or wait before recording"
                )
            moved = float(np.abs(blocks[-1].mean() - blocks[0].mean()))
            if moved > 0.05 * widest and moved > 8 * floor:
                return f"{recording.name}: the reading drifts by {moved:.3g} through the record; let it warm up, or remove the drift first"
    recording, s = min(zip(recordings, spectra, strict=True), key=lambda pair: pair[1].samples * pair[1].dt)
    y = _reading(recording, s, output) - drift_of(s)[1]
    if s.periods >= 2 and (change := _changes(_by_period(s, y))[0]) > max(0.01 * s.peak_to_peak, 8 * np.sqrt(2 * s.noise.white)):
        return (
            f"{recording.name}: the periods do not repeat: the last differs from the first by {change:.3g} rms within "
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
    if not changes or np.median(risen) < RESTLESS or np.mean(np.asarray(changes) > 0.01) < OWN_SHARE:
        return None
    return float(np.median(changes))


def _reading(recording, s, output):
    """The samples that a spectrum was made of: the reading less a start that decays with the mechanics."""
    y = np.asarray(recording.channels[output])[: s.samples]
    return y if s.start is None else y - s.start


def _by_period(s, y):
    """The samples period by period, (periods, samples); periods need not divide the sampling."""
    step = int(s.samples / s.periods)
    cycles = np.arange(s.samples) * s.dt * s.frequency
    return np.stack([np.interp(k + np.arange(step) / step, cycles, y) for k in range(s.periods)])


def _changes(blocks):
    """Rms of the last period less the first, and less the one before it."""
    first = float(np.sqrt(np.mean((blocks[0] - blocks[-1]) ** 2)))
    return first, float(np.sqrt(np.mean((blocks[-2] - blocks[-1]) ** 2))) if len(blocks) > 2 else 0.0


def wrong_bench(result) -> str | None:
    """A bench file that cannot be this bench: swapped sign of the reading."""
    correlation = []
    for s in result.spectra:
        if len(s.reading) > 1 and abs(s.drive[1]) > 0:
            correlation.append(np.angle(s.reading[1] / s.drive[1]))
    slow = [
        c
        for c, s in zip(correlation, result.spectra, strict=True)
        if s.frequency <= min(x.frequency for x in result.spectra) * 1.01
    ]
    if slow and all(abs(c) > 0.75 * np.pi for c in slow) and not result.chi2_per_sample <= 20:  # a fit that broke down too
        return "the reading falls where the drive rises at the lowest frequency: the sign of a channel is swapped; set scale = -1 in [columns]"
    return None
