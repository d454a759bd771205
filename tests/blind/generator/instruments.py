"""From settled periods to what a recorder writes: sampling, noise, counts, and the faults of a bad day."""

import numpy as np
from scipy.interpolate import CubicSpline

from .sensor import beside

PERIODS = 4
RANGE = 2e-4  # m, of the converter


def sample_times(frequency, instruments):
    """Times of four periods, s: a fixed number a period, or a clock of its own that does not divide it."""
    if instruments.get("rate"):
        return np.arange(int(PERIODS / frequency * instruments["rate"])) / instruments["rate"]
    count = instruments["samples"] * PERIODS
    return np.arange(count) * (PERIODS / frequency / count)


def pink(count, rng):
    """Noise whose power falls as 1/f, of unit rms."""
    spectrum = np.fft.rfft(rng.normal(size=count))
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    spectrum[0] = 0
    x = np.fft.irfft(spectrum, count)
    return x / x.std()


def record(settled, drive, effects, instruments, rng):
    """time (s), current (A), displacement (m) as written; `settled` holds one period, "turns" of the drive's long."""
    f = float(drive["frequency"])
    time = sample_times(f, instruments)
    y, I = (_at(settled[name], f / settled["turns"], time) for name in ("reading", "command"))
    y = y + beside(time, float(np.mean(settled["current"] ** 2)), effects, rng)
    fault = instruments.get("fault")
    if fault == "unsettled":
        y = y + 0.05 * np.ptp(y) * np.exp(-time * f / 1.5) * np.cos(2 * np.pi * 0.37 * f * time)
    y = y + instruments["noise"] * rng.normal(size=len(time)) + instruments["pink"] * pink(len(time), rng)
    if fault == "clipped":
        y = np.clip(y, None, y.min() + 0.9 * np.ptp(y))
    count = RANGE / 2 ** instruments["bits"]
    y = np.round(y / count) * count
    if instruments["readback"]:
        I = np.round((I + instruments["readback"] * rng.normal(size=len(time))) / 3e-5) * 3e-5
    if fault == "swapped_sign":
        I = -I
    if fault == "milliamperes":
        I = 1e3 * I
    if fault == "missing":
        keep = np.ones(len(time), bool)
        keep[rng.integers(len(time), size=5)] = False
        time, I, y = time[keep], I[keep], y[keep]
    return time, I, y


def _at(period, frequency, time):
    """A settled waveform at any time: its own samples where they fit, a periodic spline otherwise."""
    phase = time * frequency % 1.0
    place = phase * len(period)
    near = np.round(place).astype(int)
    if np.abs(place - near).max() < 1e-6:
        return period[near % len(period)]
    return CubicSpline(np.arange(len(period) + 1), np.append(period, period[0]), bc_type="periodic")(place)
