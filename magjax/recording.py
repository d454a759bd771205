"""A recording: uniform time, named channels in SI, where it came from; and what can be read off it without a model.

Reading files is in `readers`; this module holds the value and its judgements: fundamental, periods, noise from repeats.
"""

import dataclasses

import numpy as np

from .errors import RecordingError


@dataclasses.dataclass(frozen=True)
class Recording:
    """One run. `time`: s, uniform, (time,); `channels`: quantity -> SI values (time,); `noise`: rms if known.

    Refuses NaN, non-uniform time and clipping with a `RecordingError` that says where and how to mend it.
    """

    time: np.ndarray
    channels: dict
    noise: dict = dataclasses.field(default_factory=dict)
    origin: dict = dataclasses.field(default_factory=dict)
    name: str = "recording"

    def __post_init__(self):
        if len(self.time) < 16:
            raise RecordingError(f"{self.name}: only {len(self.time)} samples; record at least one whole period (16 samples or more)")
        for channel, values in self.channels.items():
            if len(values) != len(self.time):
                raise RecordingError(f"{self.name}: channel {channel} has {len(values)} samples, time has {len(self.time)}")
            bad = np.flatnonzero(~np.isfinite(values))
            if len(bad):
                raise RecordingError(
                    f"{self.name}: {channel} is not a number at sample {bad[0]} (t = {self.time[bad[0]]:.6g} s, {len(bad)} in all); "
                    "cut the run there or fill the gap before fitting"
                )
        self._check_time()
        for channel, values in self.channels.items():
            if channel != "time":
                _check_clipping(self.name, channel, np.asarray(values))

    def _check_time(self):
        if not np.all(np.isfinite(self.time)):
            raise RecordingError(f"{self.name}: time is not a number at sample {int(np.argmin(np.isfinite(self.time)))}; rewrite the time column")
        steps = np.diff(self.time)
        dt = np.median(steps)
        if not dt > 0:
            raise RecordingError(f"{self.name}: time does not increase at sample {int(np.argmin(steps)) + 1}; sort the rows or mend the clock")
        worst = int(np.argmax(np.abs(steps - dt)))
        if abs(steps[worst] - dt) > 0.3 * dt:
            raise RecordingError(
                f"{self.name}: time is not uniform: step {steps[worst]:.6g} s at sample {worst + 1} where {dt:.6g} s is usual; "
                "resample to a uniform clock or cut at the gap"
            )

    @property
    def dt(self) -> float:
        """Sample step, s."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def drive(self) -> str:
        """Name of the driving channel: "current" or "field"."""
        return "current" if "current" in self.channels else "field"

    def frequency(self) -> float | None:
        """Fundamental of the drive, Hz; None where less than 0.9 of a period is recorded or nothing repeats."""
        return fundamental(np.asarray(self.channels[self.drive], float), self.dt, self.origin.get("metadata", {}).get("frequency_Hz"))

    def periods(self) -> float:
        """How many periods were recorded (0 where aperiodic)."""
        f = self.frequency()
        return 0.0 if f is None else len(self.time) * self.dt * f


def _check_clipping(name, channel, values):
    span = np.ptp(values)
    if span == 0:
        raise RecordingError(f"{name}: {channel} never changes ({values[0]:.6g}); check the wiring or the column")
    for extreme, word in ((values.max(), "highest"), (values.min(), "lowest")):
        at = np.abs(values - extreme) <= 1e-9 * span
        edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
        starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        longest = int((ends - starts).max())
        lsb = np.diff(np.unique(values))
        coarse = len(lsb) and span / np.median(lsb) < 300
        if longest < max(8, 0.015 * len(values) / max(len(starts), 1)) or coarse:
            continue
        # a crest sampled with little noise is round: the samples beside a clipped plateau arrive with a slope
        first = starts[np.argmax(ends - starts)]
        before = abs(values[max(first - 1, 0)] - values[max(first - 3, 0)])
        if before > 1.5e-3 * span and first > 3:
            raise RecordingError(
                f"{name}: {channel} is clipped at its {word} value {extreme:.6g} for {longest} samples from sample {first}; "
                "lower the gain or the drive and record again"
            )


def fundamental(x: np.ndarray, dt: float, hint=None) -> float | None:
    """The repetition frequency of a signal to sub-sample precision, Hz.

    From the hint or the autocorrelation, then refined by maximising the power in the first harmonics of a least-squares
    fit over the whole record (periods need not divide the record).
    """
    n = len(x)
    x = x - x.mean()
    if np.ptp(x) == 0:
        return None
    if hint:
        f = float(hint)
        if n * dt * f < 0.9:
            return None
        return _refine(x, dt, f) if n * dt * f > 1.2 else f
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(x, size)) ** 2
    raw = np.fft.irfft(spectrum, size)[:n]
    overlap = np.cumsum((x**2)[::-1])[::-1]
    head = np.cumsum(x**2)
    lags = np.arange(n)
    norm = 0.5 * (overlap[lags] + head[n - 1 - lags])
    correlation = raw / np.maximum(norm, 1e-300)
    usable = correlation[: max(int(0.8 * n), 3)]
    below = np.flatnonzero(usable < 0.5)
    if len(below):
        tail = usable[below[0] :]
        best = tail.max() if len(tail) else 0.0
        if best > 0.9:
            peaks = np.flatnonzero((tail[1:-1] >= tail[:-2]) & (tail[1:-1] >= tail[2:]) & (tail[1:-1] > best - 0.02)) + 1
            if len(peaks):
                return _refine(x, dt, 1.0 / ((below[0] + peaks[0]) * dt))
    # one period alone: it closes on itself
    if abs(x[0] - x[-1]) < 4 * np.abs(np.diff(x)).max():
        return 1.0 / (n * dt)
    return None


def _refine(x, dt, f):
    n = len(x)
    t = dt * np.arange(n)

    def leftover(freq):
        angle = 2 * np.pi * freq * t
        design = np.stack([np.ones(n)] + [g(h * angle) for h in (1, 2, 3) for g in (np.cos, np.sin)])
        coefficients = np.linalg.solve(design @ design.T + 1e-12 * n * np.eye(7), design @ x)
        return np.sum((x - coefficients @ design) ** 2)

    width = 0.25 / (n * dt)
    for _ in range(12):
        trial = np.array([f - width, f, f + width])
        cost = np.array([leftover(v) for v in trial])
        bend = cost[0] - 2 * cost[1] + cost[2]
        shift = 0.5 * (cost[0] - cost[2]) / bend * width if bend > 0 else width * np.sign(cost[0] - cost[2])
        f += float(np.clip(shift, -width, width))
        width *= 0.4
    # a record that closes within a hundredth of a sample is taken to close
    samples = 1 / (f * dt)
    nearest = round(samples * 200) / 200
    return 1.0 / (nearest * dt) if abs(samples - nearest) < 1e-4 * samples / max(n / samples, 1) else f


def load_recordings(paths, bench) -> list[Recording]:
    """Read files (CSV, NetCDF, .mat, acquisition logs) as the bench maps their columns; see `readers`."""
    from .readers import load_recordings as load

    return load(paths, bench)
