"""Summaries of what a fit leaves: by phase, along the record, against field and its rate, and its autocorrelation."""

import numpy as np

FIELD_BINS, RATE_BINS = 24, 16
TRACE_POINTS = 160
LAGS_A_PERIOD = 60


def by_phase(s, signal, bins: int):
    """(bin centres in cycles, means, samples a bin) of a signal folded to one period."""
    bins = min(bins, max(8, int(s.samples / max(s.periods, 1))))
    place = np.minimum(((np.arange(s.samples) * s.dt * s.frequency + 1e-9) % 1.0 * bins).astype(int), bins - 1)
    count = np.bincount(place, minlength=bins)
    mean = np.bincount(place, signal, minlength=bins) / np.maximum(count, 1)
    keep = count > 0
    # phases are those of the samples themselves, not of the bins' middles
    phase = np.bincount(place, (np.arange(s.samples) * s.dt * s.frequency + 1e-9) % 1.0, minlength=bins) / np.maximum(count, 1)
    return phase[keep], mean[keep], count[keep]


def repeating(evidence) -> tuple[np.ndarray, np.ndarray]:
    """Rms of the misfit that repeats every period and of its noise, one each a recording, unit of the reading."""
    amplitudes = (np.nan_to_num(evidence["lines"][key], nan=0.0) for key in ("misfit", "floor"))
    misfit, noise = (np.sqrt(a[:, 0] ** 2 + 0.5 * np.sum(a[:, 1:] ** 2, axis=1)) for a in amplitudes)
    return misfit, noise


def strokes(evidence) -> np.ndarray:
    """Peak to peak of each reading; of evidence that does not hold it, where a loop was kept, else nan."""
    if "stroke" in evidence:
        return np.asarray(evidence["stroke"])
    loops = evidence["loops"]
    return np.array([np.ptp(loops[str(k)]["measured"]) if str(k) in loops else np.nan for k in range(len(evidence["name"]))])


def traces(spectra, scaled) -> dict:
    """The residual over its noise along each record, block means times the root of the block: unit variance if white."""
    found = {}
    for k, (s, r) in enumerate(zip(spectra, scaled, strict=True)):
        blocks = np.array_split(r, min(TRACE_POINTS, len(r)))
        at = np.cumsum([len(b) for b in blocks]) - 0.5 * np.array([len(b) for b in blocks])
        found[str(k)] = {"periods": at * s.dt * s.frequency, "value": np.array([b.mean() * np.sqrt(len(b)) for b in blocks])}
    return found


def by_field_and_rate(spectra, applied, scaled) -> dict:
    """Means of the scaled residual with their standard errors and its 5 and 95 % points, on each branch, in bins of the
    applied field (A/m) and of its rate (A/m/s)."""
    rate = [np.gradient(h, s.dt) for h, s in zip(applied, spectra, strict=True)]
    field, rate, value = (np.concatenate(x) for x in (applied, rate, scaled))
    speed = np.abs(rate)
    top = speed.max()
    slow = max(np.quantile(speed, 0.02), 1e-4 * top)
    return {
        "field": _binned(field, rate > 0, value, np.linspace(field.min(), field.max(), FIELD_BINS + 1)),
        "rate": _binned(speed, rate > 0, value, np.geomspace(slow, top * (1 + 1e-9), RATE_BINS + 1)),
    }


def _binned(x, rising, value, edges) -> dict:
    place = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2)
    found = {"edges": edges}
    for name, branch in (("rising", rising), ("falling", ~rising)):
        rows = np.full((4, len(edges) - 1), np.nan)
        for b in range(len(edges) - 1):
            inside = value[branch & (place == b)]
            if len(inside) > 4:
                rows[:, b] = inside.mean(), inside.std() / np.sqrt(len(inside)), *np.quantile(inside, (0.05, 0.95))
        found[name] = rows
    return found


def autocorrelation(spectra, residuals) -> dict:
    """Autocorrelation over lags in periods, mean over the recordings: of the residual and of what lies between the
    harmonics alone (the noise); `band`: 95 % of white noise of the same length."""
    longest = min(2.0, 0.5 * min(s.periods for s in spectra))
    lags = np.arange(1, int(longest * LAGS_A_PERIOD) + 1) / LAGS_A_PERIOD
    rows = {"residual": np.zeros(len(lags)), "noise": np.zeros(len(lags))}
    total = 0
    for s, residual in zip(spectra, residuals, strict=True):
        steps = np.maximum(np.round(lags / (s.dt * s.frequency)).astype(int), 1)
        for name, signal in (("residual", residual), ("noise", s.residue)):
            rows[name] += s.samples * _correlation(np.asarray(signal), np.minimum(steps, s.samples - 2))
        total += s.samples
    return {"lag": lags, "band": np.array(1.96 / np.sqrt(max(total, 1))), **{name: row / total for name, row in rows.items()}}


def _correlation(x, steps):
    """Autocorrelation at these lags, in samples."""
    x = x - x.mean()
    size = 1 << (2 * len(x) - 1).bit_length()
    raw = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)
    return raw[steps] / max(raw[0], 1e-300) * len(x) / (len(x) - steps)
