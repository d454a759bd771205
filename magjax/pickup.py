"""Periodic channels mended and integrated: stray samples dropped, gaps filled, repeated captures joined, a pick-up coil's emf into flux density.

All three rest on one model of a periodic signal, a constant and its harmonics fitted by least squares to the samples that
are there; so periods need not divide the sampling, and a gap needs no interpolation across it.
"""

import numpy as np

from .errors import RecordingError
from .recording import fundamental, whole_periods

MOST_HARMONICS = 40
MOST_MISSING = 0.1  # of the samples
STRAY = 15.0  # times the scatter of the samples about their harmonics: none of a million lies as far out by chance
MOST_STRAY, WIDEST_STRAY = 2e-3, 3  # of the samples that may stray, and how many in a row
MOST_ROUNDS = 12


def _harmonics(phases, orders):
    """Cosines and sines at phases (cycles): (samples, 2 orders)."""
    angle = 2 * np.pi * np.outer(phases, np.arange(1, orders + 1))
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def _design(phases, orders):
    """Constant and harmonics at phases (cycles): (samples, 1 + 2 orders)."""
    return np.concatenate([np.ones((len(phases), 1)), _harmonics(phases, orders)], axis=1)


def _orders(phases, per_period):
    """How many harmonics the phases bear: none whose half wave fits into the widest stretch of phase without a sample."""
    sorted_phases = np.sort(phases % 1.0)
    hole = float(np.max(np.diff(np.append(sorted_phases, sorted_phases[0] + 1.0))))
    return int(max(1, min(MOST_HARMONICS, 0.4 * per_period, 0.5 / hole)))


def _grid(time, channels):
    """(dt, whole-number positions, samples missing) where the steps are whole multiples of the usual one, else None."""
    steps = np.diff(time)
    dt = float(np.median(steps))
    if not dt > 0 or len(time) < 64 or not all(np.all(np.isfinite(v)) for v in channels.values()):
        return None
    multiples = np.round(steps / dt)
    if multiples.min() < 1 or np.abs(steps / dt - multiples).max() > 0.1:
        return None
    index = np.concatenate([[0], np.cumsum(multiples)]).astype(int)
    missing = index[-1] + 1 - len(index)
    return (dt, index, missing) if missing <= MOST_MISSING * (index[-1] + 1) else None


def bridge_gaps(time, channels, drive):
    """Fill missing samples of a periodic run from the harmonics that fit the rest; (time, channels, samples filled).

    Only where the steps are whole multiples of the usual one, the drive repeats at least twice, and less than a tenth of
    the samples is missing; else everything is returned as it is, and `Recording` says where the gap lies.
    """
    grid = _grid(time, channels)
    if grid is None or grid[2] == 0:
        return time, channels, 0
    dt, index, missing = grid
    full = np.arange(index[-1] + 1)
    f = fundamental(np.interp(full, index, channels[drive]), dt)
    if f is None or len(full) * dt * f < 2:
        return time, channels, 0
    orders = _orders(f * dt * index, 1 / (f * dt))
    wanted = np.setdiff1d(full, index)
    known, lacking = _design(f * dt * index, orders), _design(f * dt * wanted, orders)
    filled = {q: _fill(full, index, wanted, v, lacking @ np.linalg.lstsq(known, v, rcond=None)[0]) for q, v in channels.items()}
    return dt * full, filled, missing


def without_empty(time, channels):
    """The samples without those that lack a channel (empty cells), as if they had not been taken: a gap, which `bridge_gaps` fills;
    (time, channels). All of them where these are too many to be filled: `Recording` says where they lie."""
    lacking = np.any([np.isnan(v) for v in channels.values()], axis=0)
    if not lacking.any() or lacking.sum() > MOST_MISSING * len(time):
        return time, channels
    whole = {q: v[~lacking] for q, v in channels.items()}
    return time[~lacking] - time[~lacking][0], whole


def without_strays(time, channels, drive):
    """A periodic run with single samples far off, as interference leaves, put where their harmonics are: (channels, {channel: how many}).

    What lies beyond `STRAY` times the scatter about the harmonics of its channel (of the median, so that strays do not count in
    it), a few samples at most, and at no such phase of another period: an edge that repeats is the signal's own. Only where the
    drive repeats three times; else, and where more than a few stray, everything is returned as it is.
    """
    grid = _grid(time, channels) if any(_jumps(v) for v in channels.values()) else None
    if grid is None:
        return channels, {}
    dt, index, _ = grid
    full = np.arange(index[-1] + 1)
    mended, counts = {**channels, drive: _by_neighbours(channels[drive])}, {}
    for _ in range(2):  # a stray of the drive moves its period, and with it all others
        f = fundamental(np.interp(full, index, mended[drive]), dt)
        if f is None or whole_periods(len(full), 1 / (f * dt)) < 3:
            return channels, {}
        phases = f * dt * index
        design = _design(phases, _orders(phases, 1 / (f * dt)))
        mended, counts = dict(channels), {}
        for name, values in channels.items():
            bad, smooth = _strays(values, design, phases) if _jumps(values) else (np.zeros(len(values), bool), values)
            if bad.any():
                mended[name], counts[name] = np.where(bad, smooth, values), int(bad.sum())
    return mended, counts


def _jumps(values) -> bool:
    """Whether a sample lies off its neighbours far more than most do: a look before the harmonics are fitted."""
    bend = np.abs(np.diff(values, 2))
    return len(bend) > 0 and bool(bend.max() > STRAY * np.median(bend) / 0.6745)


def _by_neighbours(values):
    """The channel with samples far off the middle of their neighbours put there: good enough to find its period by."""
    around = np.stack([np.roll(values, k) for k in (-2, -1, 1, 2)])
    around[:, :2], around[:, -2:] = values[2:4].mean(), values[-4:-2].mean()
    middle = np.median(around, axis=0)
    off = np.abs(values - middle)
    return np.where(off > STRAY * np.median(off) / 0.6745, middle, values)


def _strays(values, design, phases):
    """Which samples of a channel stray, none where these are too many to be strays, and its harmonics without them: (samples,) each."""
    none, most = np.zeros(len(values), bool), max(MOST_STRAY * len(values), WIDEST_STRAY)
    bad = none
    for _ in range(MOST_ROUNDS):  # a stray moves the harmonics and hides smaller ones behind what it does to its neighbours
        some = design[~bad]
        smooth = design @ np.linalg.solve(some.T @ some, some.T @ values[~bad])
        off = np.abs(values - smooth)
        rest = np.where(bad, 0.0, off)
        now = rest > max(STRAY * np.median(rest) / 0.6745, 0.5 * rest.max())
        if not now.any() or bad.sum() > most:
            break
        bad = bad | now
    if not bad.any() or bad.sum() > most or now.any():
        return none, smooth
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], bad, [0]]))))[::2]
    if not bad.any() or now.sum() > most or runs.max() > WIDEST_STRAY:
        return none, smooth
    at, step = phases % 1.0, phases[1] - phases[0]
    for k in np.flatnonzero(bad):
        away = np.abs(at - at[k])
        same = (np.minimum(away, 1 - away) < 1.5 * step) & (np.abs(phases - phases[k]) > 0.5)
        if same.any() and off[same].max() > 0.3 * off[k]:
            return none, smooth
    return bad, smooth


def _fill(full, index, wanted, values, guesses):
    whole = np.empty(len(full))
    whole[index], whole[wanted] = values, guesses
    return whole


def merge_captures(captures, bench, path):
    """Repeated captures of one periodic run, not aligned, as one record: whole periods cut at the drive's crest.

    The phase of each capture is read off its drive's fundamental. What a capture lacks is filled from the harmonics fitted
    to all captures together (gaps at one place in every capture lie at different phases), and its whole periods are
    resampled to a common grid by cubic splines. A pick-up coil's emf loses its mean in each period, so that its integral
    closes. Returns (columns, samples filled); raises `RecordingError` where a capture is not periodic or not uniform.
    """
    from scipy.interpolate import CubicSpline

    drive = bench.drive
    grids, frequencies = [], []
    for k, capture in enumerate(captures):
        channels = {q: v for q, v in capture.items() if q != "time"}
        grid = _grid(capture["time"], channels)
        if grid is None:
            raise RecordingError(
                f"{path}: capture {k} has a NaN, fewer than 64 samples, or a time that is not uniform; cut it out of the file or record it again"
            )
        dt, index, _ = grid
        f = fundamental(np.interp(np.arange(index[-1] + 1), index, channels[drive]), dt)
        if f is None or (index[-1] + 1) * dt * f < 1.2:
            raise RecordingError(
                f"{path}: the {drive} of capture {k} does not repeat; merge needs captures of two periods (columns.time.merge)"
            )
        grids.append((dt, index, channels))
        frequencies.append(f)
    f, per = float(np.median(frequencies)), int(round(1 / (float(np.median(frequencies)) * grids[0][0])))
    # phase of each sample in cycles, zero at the drive's crest
    phases = []
    for dt, index, channels in grids:
        _, a, b = np.linalg.lstsq(_design(f * dt * index, 1), channels[drive], rcond=None)[0]
        phases.append(f * dt * index - np.arctan2(b, a) / (2 * np.pi))
    together = np.concatenate(phases)
    orders = _orders(together, per)
    # a level for each capture: offsets that differ must not lean on the harmonics
    levels = np.repeat(np.eye(len(phases)), [len(phase) for phase in phases], axis=0)
    design = np.concatenate([levels, _harmonics(together, orders)], axis=1)
    models = {
        q: np.linalg.lstsq(design, np.concatenate([c[q] for _, _, c in grids]), rcond=None)[0][len(phases) :] for q in grids[0][2]
    }
    merged, filled = {q: [] for q in models}, 0
    for (dt, index, channels), phase in zip(grids, phases, strict=True):
        full = np.arange(index[-1] + 1)
        wanted = np.setdiff1d(full, index)
        filled += len(wanted)
        start = (-phase[0]) % 1.0 / (f * dt)
        whole = int(np.floor((full[-1] - start) * f * dt))
        at = start + np.arange(whole * per) / (per * f * dt)
        known, lacking = _harmonics(phase, orders), _harmonics(phase[0] + f * dt * wanted, orders)
        for q, values in channels.items():
            level = float(np.mean(values - known @ models[q]))
            record = _fill(full, index, wanted, values, lacking @ models[q] + level)
            periods = CubicSpline(full, record)(at).reshape(whole, per)
            if "emf_turns" in bench.columns.get(q, {}):
                periods = periods - periods.mean(axis=1, keepdims=True)
            merged[q].append(periods.ravel())
    joined = {q: np.concatenate(v) for q, v in merged.items()}
    return {"time": np.arange(len(joined[drive])) / (per * f), **joined}, filled


def integrate_emf(emf, drive, dt, column):
    """Flux density from a pick-up coil's emf = -N A dB/dt (the sign is the bench's `emf_sign`), T, zero mean.

    Of a periodic run the harmonics of dB/dt, h w, are divided by i h w, which is exact at any sampling, and only what they
    leave is summed by trapezoids; offset and drift over the whole periods are taken off. Without a period: trapezoids.
    """
    emf = np.asarray(emf, float)
    f = fundamental(np.asarray(drive, float), dt)
    rate = float(column.get("emf_sign", -1)) * emf / (float(column["emf_turns"]) * float(column["emf_area"]))
    n = len(rate)
    if f is None or n * dt * f < 0.999:
        B = _trapezoids(rate - rate.mean(), dt)
        return B - B.mean()
    whole = min(n, int(round(np.floor(n * dt * f + 1e-3) / (f * dt))))
    phases = f * dt * np.arange(n)
    orders = _orders(phases[:whole], 1 / (f * dt))
    design = _design(phases, orders)
    coefficients = np.linalg.lstsq(design[:whole], rate[:whole], rcond=None)[0]
    a, b = coefficients[1 : orders + 1], coefficients[orders + 1 :]
    pace = 2 * np.pi * f * np.arange(1, orders + 1)
    B = design @ np.concatenate([[0.0], -b / pace, a / pace])
    rest = _trapezoids(rate - design @ coefficients, dt)
    last = min(whole, n - 1)
    rest = rest - rest[last] / last * np.arange(n)
    return B + rest - rest[:whole].mean()  # the harmonics have none, and `whole` samples are periods but for a rounding


def _trapezoids(rate, dt):
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)])
