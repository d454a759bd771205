"""What is added to a whole record, whatever the drive: drift, heat and hum, scored between the harmonics of the drive.

Each is told from the reading in the time domain, by the noise's spectrum; what was found is taken out of the recordings.
"""

import dataclasses
import functools

import numpy as np

from magjax.plausibility import si_unit
from magjax.words import sized

from .spectra import ON_LINE, evaluate_lines, fit_lines, reduce_recording, with_noise

MAINS = (50.0, 60.0)
HUM_TONES, MORE_TONES = 3, (4, 5, 6, 7)  # multiples of the mains by which hum is told, and those that it may have besides
CLEAR, LEAST_SHOWN = 25.0, 0.1  # chi2 that a signal of a size would take between the harmonics, and the share that must show
STANDS_OUT = 2.5  # times the largest of the six harmonics beside it, that a hum on a harmonic of the drive is
MOST_SHOW = 0.5  # of the recordings where a signal would be clear, more of which must show it, or deny it
HEAT_TIMES = (0.3, 3.0, 30.0)  # s, by which a rod may warm
THROUGH_TIMES = (0.1, 0.3, 1.0, 3.0)  # the same of what warms through another node, with a tenth of the time of its own
NODE_TIMES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # the same of two nodes
REVERSES = 0.02  # of the largest rate of a warming, up to which it may seem to turn back
LONE_GAIN = 60.0  # fall of chi2 from which a drift of one record may be its alone
SETTLING = (0.04, 0.15)  # of the record's length: times with which such a record may settle
AS_ALIKE = 1.15  # spread of drifts per heat in units of that of the drifts, up to which they may as well be heat: of records that begin warm 1.08
BELOW = 16  # lengths of a record down to which flicker goes on
OWN_GAIN, OWN_SHARE = 12.0, 0.8  # fall of chi2 by a drift of one record alone, and the share of the longer ones that must show it


@dataclasses.dataclass(frozen=True)
class RecordEffect:
    """A record-level effect: amplitude common to the recordings with its score; `columns`: per recording."""

    name: str
    z: float
    amplitude: float
    stderr: float
    shapes: dict
    columns: tuple = dataclasses.field(repr=False, default=())


def record_columns(recordings, spectra):
    """(name, shapes, column per recording) of record-level effects at unit amplitude."""
    rows = []
    times = [s.dt * np.arange(s.samples) for s in spectra]
    rows.append(("zero_drift", {}, [t for t in times]))
    longest = max(t[-1] for t in times)
    shapes = [{"tau": tau} for tau in HEAT_TIMES]
    shapes += [dict(zip(("taus", "shares"), _scaled((tau, 10 * tau), (-1.0, 1.0), longest)[1:], strict=True)) for tau in THROUGH_TIMES]
    rows += [("thermal_drift", shape, heat_columns(recordings, spectra, shape)) for shape in shapes]
    return rows


def _scaled(taus, rates, longest):
    """Rates of nodes at the start of a record as (largest rate of them together within it, s, `taus`, their shares of that); 0 where
    it changes its sign: then it is no warming. What warms through another node begins at rest, with shares that are opposite."""
    t = np.linspace(0.0, longest, 200)
    slope = sum(rate * np.exp(-t / tau) for tau, rate in zip(taus, rates, strict=True))
    most = slope[np.argmax(np.abs(slope))]
    if np.min(slope * np.sign(most)) < -REVERSES * abs(most):
        return 0.0, taus, rates
    return float(most), taus, tuple(float(x / most) for x in rates)


def heat_columns(recordings, spectra, shapes) -> list:
    """What the mean heat of each recording adds to it at a unit rate, its largest, at its start: by one time, `tau`, or several nodes,
    `taus`, with their `shares` of that rate."""
    parts = zip(shapes.get("taus", (shapes.get("tau"),)), shapes.get("shares", (1.0,)), strict=True)
    columns = [0.0 for _ in spectra]
    for tau, share in parts:
        for n, (recording, s) in enumerate(zip(recordings, spectra, strict=True)):
            power = np.mean(np.asarray(recording.channels[recording.drive]) ** 2)
            columns[n] = columns[n] + share * power * tau * (1 - np.exp(-s.dt * np.arange(s.samples) / tau))
    return columns


def in_its_times(heat, recordings, spectra) -> RecordEffect | None:
    """A drift by heat with a time that clearly serves better than its own, or with two: winding and rod warm each in its time, or one
    through the other; None where its own serve as well."""
    longest = max(s.dt * (s.samples - 1) for s in spectra)

    def reduced(shapes):
        return [_between(s, c) for s, c in zip(spectra, heat_columns(recordings, spectra, shapes), strict=True)]

    def fitted(*parts):
        G, g = (sum(each) for each in zip(*map(_normal, zip(*parts, strict=True)), strict=True))
        rates = np.linalg.lstsq(G, g, rcond=1e-12)[0]
        return float(rates @ g), rates

    alone = {tau: reduced({"tau": tau}) for tau in NODE_TIMES}
    found = [(*fitted(alone[tau]), (tau,)) for tau in NODE_TIMES]
    best = max(found, key=lambda row: row[0])
    pairs = [(*fitted(alone[a], alone[b]), (a, b)) for a in NODE_TIMES for b in NODE_TIMES if a < b]
    pairs = [row for row in pairs if _scaled(row[2], row[1], longest)[0]]
    both = max(pairs, key=lambda row: row[0], default=best)
    fall, rates, taus = both if both[0] > best[0] + CLEAR else best
    if fall < fitted(reduced(heat.shapes))[0] + CLEAR:
        return None
    rate, taus, shares = _scaled(taus, rates, longest)
    z, shapes = float(np.sqrt(fall)), {"taus": taus, "shares": shares}
    return RecordEffect(heat.name, z, rate, abs(rate) / z, shapes, tuple(heat_columns(recordings, spectra, shapes)))


def record_effects(recordings, spectra) -> list[RecordEffect]:
    """Drift, heat and hum scored on what the harmonics leave, best first."""
    found = {}
    for name, shapes, columns in record_columns(recordings, spectra):
        top, bottom = _of_common_size(spectra, columns)
        z, amplitude = top / np.sqrt(bottom), top / bottom
        if name not in found or abs(z) > abs(found[name].z):
            found[name] = RecordEffect(name, float(z), float(amplitude), float(1 / np.sqrt(bottom)), shapes, tuple(columns))
    if own := _own_drifts(spectra, max(abs(e.z) for e in found.values())):
        found["zero_drift"] = own
        if may_be_heat(own, spectra):
            found["thermal_drift"] = by_heat(own, spectra)
    found["mains_hum"] = hum_between(spectra)
    return sorted(found.values(), key=lambda e: -abs(e.z))


def hum_between(spectra) -> RecordEffect:
    """Hum between the harmonics, of the mains frequency that shows more; z is 0 where most recordings deny it."""
    rows = []
    for f in MAINS:
        z, tones, fits = _hum(spectra, multiples(f))
        z = float(z) if hum_is_seen(spectra, tones) else 0.0
        rows.append(RecordEffect("mains_hum", z, tones[0][1], tones[0][1] / max(z, 1.0), {"f": f, "tones": tones}, tuple(fits)))
    best = max(rows, key=lambda e: e.z)
    return _with_more_tones(spectra, best) if best.z**2 > CLEAR else best


def multiples(mains, orders=()) -> list[float]:
    """Frequencies of the tones by which hum is told, and of further `orders`, Hz."""
    return [k * mains for k in (*range(1, HUM_TONES + 1), *orders)]


def _with_more_tones(spectra, hum) -> RecordEffect:
    """The same with the higher multiples of the mains that show clearly beside those by which it was told."""
    f, orders, best, reached = hum.shapes["f"], [], None, hum.z
    for order in MORE_TONES:
        z, tones, fits = _hum(spectra, multiples(f, (*orders, order)))
        if z**2 > reached**2 + CLEAR:
            orders.append(order)
            reached, best = z, (tones, tuple(fits))
    if best is None:
        return hum
    return dataclasses.replace(hum, shapes={**hum.shapes, "tones": best[0]}, columns=best[1])


def mean_heat(spectra) -> np.ndarray:
    """Mean square of the drive of each recording."""
    return np.array([abs(s.drive[0]) ** 2 + 2 * np.sum(np.abs(s.drive[1:]) ** 2) for s in spectra])


def by_heat(drifts, spectra) -> RecordEffect:
    """Drifts of each record by itself (`_own_drifts`) as those of a rod that warms: their rate per squared drive."""
    per_heat = _rates(drifts, spectra) / mean_heat(spectra)
    size, error = float(np.median(per_heat)), float(np.std(per_heat) / np.sqrt(len(spectra)))
    return dataclasses.replace(drifts, name="thermal_drift", amplitude=size, stderr=error)


def may_be_heat(drifts, spectra) -> bool:
    """Whether drifts of each record by itself go one way, at rates that go as much by the heat as they are alike."""
    rates = _rates(drifts, spectra)
    same = np.all(rates > 0) or np.all(rates < 0)
    return bool(same and np.std(np.log(np.abs(rates / mean_heat(spectra)))) <= AS_ALIKE * np.std(np.log(np.abs(rates))))


def _rates(drifts, spectra):
    return np.array([column[-1] / (s.dt * s.samples) for column, s in zip(drifts.columns, spectra, strict=True)])


def pulsation_lines(s) -> np.ndarray:
    """What the heat of the drive's square adds within a period, at unit rate: Fourier coefficients 0.. of its integral over
    time but for its mean, A^2 s."""
    count = 4 * len(s.drive)
    heat = np.fft.rfft(s.drive_at(np.arange(count) / count) ** 2)[: 2 * len(s.drive) - 1] / count
    orders = np.arange(len(heat))
    return np.where(orders > 0, heat / (2j * np.pi * np.maximum(orders, 1) * s.frequency), 0.0)


def pulsation(s) -> np.ndarray:
    """The same over the samples of a record."""
    return evaluate_lines(pulsation_lines(s), s.dt * s.frequency * np.arange(s.samples))


def pulsation_of(spectra, z: float, rate: float, error: float) -> RecordEffect:
    """The pulsation of the heat within the period, known from the harmonics (`on_lines.heat_score`)."""
    return RecordEffect("thermal_drift", z, rate, error, {"pulsation": True}, tuple(pulsation(s) for s in spectra))


def zeros_of(spectra, z: float, zeros, errors, adopted=()) -> list[RecordEffect]:
    """A zero of its own in every recording: of the sensor or, as likely from these alone, of a rod that warms and cools
    between them; or of that which drifts within them, among the names `adopted`."""
    shapes = {"zeros": float(max(s.peak_to_peak for s in spectra))}
    size, error = float(np.sqrt(np.mean(np.square(zeros)))), float(np.sqrt(np.mean(np.square(errors))))
    both = ("zero_drift", "thermal_drift")
    return [RecordEffect(name, z, size, error, shapes) for name in [n for n in both if n in adopted][:1] or both]


def hum_of(spectra, z: float, tones) -> RecordEffect:
    """Hum known from harmonics that it falls on (`on_lines.hum_score`), joined to what shows of it between the others."""
    between, shown, fits = _hum(spectra, *zip(*tones, strict=True))
    both = tuple((f, max(a, b)) for (f, a), (_, b) in zip(tones, shown, strict=True))
    z = float(np.hypot(z, between))
    return RecordEffect("mains_hum", z, both[0][1], both[0][1] / max(z, 1.0), {"f": tones[0][0], "tones": both}, tuple(fits))


def hum_is_seen(spectra, tones) -> bool:
    """Whether hum of these tones (frequency, Hz, and amplitude) shows between the harmonics of most recordings where it must."""
    shown = []
    for s in spectra:
        parts, kinds = _tones(s, [f for f, _ in tones])
        if not parts or s.samples * s.dt < 2 / tones[0][0]:
            continue
        fall = _combination([reduced for _, reduced in parts])[1] - len(parts)
        power = [np.sum(weight * np.abs(c) ** 2) for _, (weight, _, c) in parts]
        promised = float(np.sum(np.square([tones[k][1] for k in kinds]) * power) / 2)
        if promised > CLEAR:
            shown.append(fall > LEAST_SHOWN * promised)
    return not shown or bool(np.mean(shown) > MOST_SHOW)


def lone_drifts(spectra) -> dict:
    """Drifts that one record alone shows, though at its rate, or by its heat, most others would: {recording: samples}."""
    gains, fits = zip(*(drift_of(s) for s in spectra), strict=True)
    heat, lone = mean_heat(spectra), {}
    for k, (gain, fit) in enumerate(zip(gains, fits, strict=True)):
        others = [n for n in range(len(spectra)) if n != k]
        if gain < LONE_GAIN or len(others) < 2 or np.median([gains[n] for n in others]) > OWN_GAIN:
            continue
        rate = fit[-1] / (spectra[k].dt * spectra[k].samples)
        denied = 0
        for n in others:
            weight, _, column = _between(spectra[n], spectra[n].dt * np.arange(spectra[n].samples))
            promised = (rate * min(1.0, heat[n] / heat[k])) ** 2 * np.sum(weight * np.abs(column) ** 2)
            denied += promised > CLEAR and gains[n] < LEAST_SHOWN * promised
        if denied >= max(2, MOST_SHOW * len(others)):
            lone[k] = drift_of(spectra[k], SETTLING)[1]
    return lone


def without_lone_drifts(recordings, lone, output):
    """The recordings without the drifts that some of them alone show, and what is to be told of each in words."""
    cleaned, told = list(recordings), []
    for k, fit in lone.items():
        reading = np.asarray(recordings[k].channels[output], float)
        origin = {**recordings[k].origin, "zero": float(np.ptp(reading))}  # where it settles is not known
        cleaned[k] = dataclasses.replace(recordings[k], channels={**recordings[k].channels, output: _less(reading, fit)}, origin=origin)
        told.append(
            f"{recordings[k].name} alone drifts, by {sized(si_unit(output), np.ptp(fit))}, which was taken out: it was not settled, or its sensor moved."
        )
    return cleaned, told


def _less(reading, signal):
    """A reading less a signal of its first samples, which keeps its last value beyond them."""
    return np.asarray(reading, float) - np.append(signal, np.full(len(reading) - len(signal), signal[-1]))


def drift_of(s, settling=()):
    """The drift of one record by itself, straight and by the root of time, and settling with some times in units of its length,
    from zero at its start: (fall of chi2, samples)."""
    t = s.dt * np.arange(s.samples)
    parts = [t / t[-1], np.sqrt(t / t[-1]), *(1 - np.exp(-t / (tau * t[-1])) for tau in settling)]
    best, gain = _combination([_between(s, p) for p in parts])
    return gain, sum(x * p for x, p in zip(best, parts, strict=True))


def _of_common_size(spectra, columns, share=lambda s: 1.0):
    """Right side and matrix of the normal equation of columns that have one size in all records; `share`: of what a record tells of it."""
    top, bottom = 0.0, 0.0
    for s, column in zip(spectra, columns, strict=True):
        weight, r, c = _between(s, column)
        weight = share(s) * weight
        top += float(np.sum(weight * (np.conj(c) * r).real))
        bottom += float(np.sum(weight * np.abs(c) ** 2))
    return top, bottom


def _normal(reduced):
    """Matrix and right side of the normal equations of columns of one record, as `_between` gives them."""
    G = np.array([[np.sum(a[0] * (np.conj(a[2]) * b[2]).real) for b in reduced] for a in reduced])
    return G, np.array([np.sum(a[0] * (np.conj(a[2]) * a[1]).real) for a in reduced])


def _combination(reduced, sizes=None):
    """Amplitudes of columns of one record, as `_between` gives them, by least squares, and the fall of chi2; `sizes`: the
    standard deviation of each that is known beforehand."""
    G, g = _normal(reduced)
    known = 0.0 if sizes is None else np.diag(1 / np.square(sizes))
    best = np.linalg.solve(G + 1e-9 * np.trace(G) * np.eye(len(G)) + known, g)
    return best, float(best @ g)


def _own_drifts(spectra, common: float) -> RecordEffect | None:
    """Drift of each record by itself, where that serves better (BIC) than what scores `common` by one rate; None elsewhere."""
    gains, fits = zip(*(drift_of(s) for s in spectra), strict=True)
    extra, count = 2 * len(spectra), sum(s.samples for s in spectra)
    # short records show none; a hum looks like one in them alone
    long = np.asarray([s.samples * s.dt for s in spectra])
    shown = np.mean(np.asarray(gains)[long >= np.median(long)] > OWN_GAIN)
    if shown < OWN_SHARE or sum(gains) - common**2 < extra * np.log(count):
        return None
    ends = np.array([f[-1] / (s.dt * s.samples) for f, s in zip(fits, spectra, strict=True)])
    rate = float(np.median(ends))
    z = float(np.sqrt(max(sum(gains) - extra, 0.0)))
    return RecordEffect("zero_drift", z, rate, float(np.std(ends) / np.sqrt(len(ends))), {"own": True}, fits)


def _hum(spectra, frequencies, amplitudes=None):
    """Hum of tones, Hz, the first that of the mains, with phases of their own in each record: (z, tones, fits).

    `tones`: (frequency, largest amplitude over the records) of each; a tone that falls on a harmonic of the drive cannot be
    told from the reading there, and a record shorter than two of its periods tells no tone from slow noise: it takes no
    part in the score, and its own tones are held to the size of the others', or to `amplitudes` where they are known.
    """
    longest = max(s.samples * s.dt for s in spectra)
    gain, number, power, fits = 0.0, 0, np.zeros(len(frequencies)), {}
    for s in sorted(spectra, key=lambda s: -s.samples * s.dt):
        long = s.samples * s.dt >= min(2 / frequencies[0], longest * 0.999)
        parts, kinds = _tones(s, frequencies)
        if not parts:
            fits[id(s)] = np.zeros(s.samples)
            continue
        known = power if amplitudes is None else np.asarray(amplitudes)
        held = amplitudes is not None if long else known.any()
        sizes = np.maximum(known[kinds], 1e-3 * known.max()) / np.sqrt(2) if held else None
        best, fall = _combination([reduced for _, reduced in parts], sizes)
        if long:
            gain += fall
            number += len(parts)
            for k in set(kinds):
                power[k] = max(power[k], float(np.linalg.norm(best[np.asarray(kinds) == k])))
        fits[id(s)] = sum(x * p for x, (p, _) in zip(best, parts, strict=True))
    z = np.sqrt(max(gain - number, 0.0))  # of the same scale as one column's score
    return z, tuple((f, float(p)) for f, p in zip(frequencies, power, strict=True)), [fits[id(s)] for s in spectra]


def _tones(s, frequencies):
    """Cosine and sine of each tone that shows between the harmonics, with what `_between` makes of them; and which tone."""
    t = s.dt * np.arange(s.samples)
    parts, kinds = [], []
    for k, f in enumerate(frequencies):
        pair = [np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)]
        reduced = [_between(s, p) for p in pair]
        seen = sum(np.sum(np.abs(c) ** 2) for _, _, c in reduced) / sum(np.sum(np.abs(np.fft.rfft(p)) ** 2) for p in pair)
        if f < 0.45 / s.dt and seen > 0.05 and not _is_own(s, f):
            parts += list(zip(pair, reduced, strict=True))
            kinds += [k, k]
    return parts, kinds


def _is_own(s, f) -> bool:
    """Whether a tone falls on a harmonic of the drive beyond those that the reading is told by, and stands out from the next ones no
    more than they do."""
    order = int(round(f / s.frequency))
    if order < len(s.reading) or abs(f - order * s.frequency) * s.samples * s.dt > ON_LINE:
        return False
    beside = np.array([k for k in range(order - 3, order + 4) if k >= len(s.reading) and k != order])
    orders = np.append(beside, order)
    waves = np.exp(-2j * np.pi * np.outer(orders, np.arange(s.samples) * s.dt * s.frequency))
    *others, own = np.abs(waves @ s.residue)
    return own < STANDS_OUT * max(others)


def _between(s, column):
    """Weights, residue and column in the frequency domain, both without the harmonics."""
    phases = np.arange(s.samples) * s.dt * s.frequency
    left = fit_lines(np.asarray(column, float), phases, len(s.reading) - 1)[1]
    f = np.fft.rfftfreq(s.samples, s.dt)
    weight = 2.0 / (s.samples * s.noise.density(np.maximum(f, f[1])))
    weight[0] = 0.0
    return weight, np.fft.rfft(s.residue), np.fft.rfft(left)


@functools.lru_cache(maxsize=256)
def _steadiness(samples: int, dt: float, frequency: float, harmonics: int, noise) -> float:
    phases = np.arange(samples) * dt * frequency
    column = fit_lines(dt * np.arange(samples), phases, harmonics)[1]
    c, f = np.fft.rfft(column), np.fft.rfftfreq(samples, dt)
    told = c / noise.density(np.maximum(f, f[1]))
    told[0] = 0.0
    taken = fit_lines(np.fft.irfft(told, samples), phases, harmonics)[1]  # what the score takes of the reading
    number = BELOW * samples
    spread = np.abs(np.fft.rfft(taken, number)[1:]) ** 2 * noise.density(np.fft.rfftfreq(number, dt)[1:])
    return float(min(1.0, samples * np.mean(column * taken) * number / (2 * spread.sum())))


def steadiness(s) -> float:
    """The share of what its bins say of a drift that a record tells: flicker goes on below the first of them, where it looks like one."""
    return _steadiness(s.samples, s.dt, s.frequency, len(s.reading) - 1, s.noise)


def score_of(drift, spectra) -> float:
    """The score of a drift by other noise than that by which it was found, and by what its records tell of one."""
    top, bottom = _of_common_size(spectra, drift.columns, steadiness)
    return abs(top) / np.sqrt(bottom)


def remove_record_effect(recordings, effect, output):
    """The recordings with a record-level signal taken out of the reading; with zeros of their own, their means are set free."""
    if size := effect.shapes.get("zeros"):
        return [dataclasses.replace(r, origin={**r.origin, "zero": size}) for r in recordings]
    cleaned = []
    for recording, column in zip(recordings, effect.columns, strict=True):
        scale = 1.0 if effect.name == "mains_hum" or effect.shapes.get("own") else effect.amplitude
        channels = {**recording.channels, output: _less(recording.channels[output], scale * column)}
        origin = recording.origin
        if effect.name == "mains_hum":
            origin = {**origin, "hum": effect.shapes["tones"]}
        elif effect.shapes.get("own"):
            origin = {**origin, "drift": float(np.abs(column).max())}
        cleaned.append(dataclasses.replace(recording, channels=channels, origin=origin))
    return cleaned


def remove_from_checks(recordings, adopted, bench):
    """Check recordings without the record-level signals that were `adopted` from the others; each record's own drift and
    hum are found between its own harmonics. Recordings that do not repeat come back as they are."""
    cleaned = []
    for recording in recordings:
        if zeros := next((e for e in adopted if e.shapes.get("zeros")), None):
            recording = remove_record_effect([recording], zeros, bench.output)[0]
        between = [e for e in adopted if not e.shapes.get("zeros")]
        for effect in between if recording.frequency() is not None else ():
            spectra = with_noise([reduce_recording(recording, bench.drive, bench.output, columns=bench.columns)])
            if effect.name == "mains_hum":
                columns = tuple(_hum(spectra, *zip(*effect.shapes["tones"], strict=True))[2])
            elif effect.shapes.get("own"):
                columns = (drift_of(spectra[0])[1],)
            elif effect.shapes.get("pulsation"):
                columns = (pulsation(spectra[0]),)
            elif effect.name == "thermal_drift":
                columns = tuple(heat_columns([recording], spectra, effect.shapes))
            else:
                same = [c for n, shapes, c in record_columns([recording], spectra) if (n, shapes) == (effect.name, effect.shapes)]
                columns = tuple(same[0])
            recording = remove_record_effect([recording], dataclasses.replace(effect, columns=columns), bench.output)[0]
        cleaned.append(recording)
    return cleaned
