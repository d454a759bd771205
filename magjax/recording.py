"""A recording: uniform time, named channels in SI, where it came from; and what can be read off it without a model.

Reading files is in `readers`; this module holds the value and its judgements: fundamental, periods, noise from repeats.
"""

import dataclasses
import functools

import numpy as np

from .clipping import refuse_clipping
from .errors import RecordingError

BYSTANDERS = ("temperature", "command")  # recorded beside: they may stand still


@dataclasses.dataclass(frozen=True)
class Recording:
    """One run. `time`: s, uniform, (time,); `channels`: quantity -> SI values (time,); `noise`: rms if known.

    Refuses NaN, non-uniform time and clipping with a `RecordingError` that says where and how to mend it. `judged`: whether clipping
    was looked for in what was measured: what `dataclasses.replace` makes of a recording was not, and has crests of its own.
    """

    time: np.ndarray
    channels: dict
    noise: dict = dataclasses.field(default_factory=dict)
    origin: dict = dataclasses.field(default_factory=dict)
    name: str = "recording"
    judged: bool = dataclasses.field(default=False, repr=False, compare=False)

    def __post_init__(self):
        if len(self.time) < 16:
            raise RecordingError(
                f"{self.name}: only {len(self.time)} samples; record at least one whole period (16 samples or more)"
            )
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
        drive = np.asarray(self.channels[self.drive], float) if self.drive in self.channels else None
        if drive is not None:
            refuse_constant(self.name, self.drive, drive)
        # a loop given as points has no time, in which alone a crest has a shape
        tested = () if self.judged or self.origin.get("quasistatic") else self.channels.items()
        for channel, values in tested:
            if channel not in ("time", *BYSTANDERS):
                refuse_clipping(self.name, channel, np.asarray(values, float), None if channel == self.drive else drive)
        object.__setattr__(self, "judged", True)

    def _check_time(self):
        if not np.all(np.isfinite(self.time)):
            raise RecordingError(
                f"{self.name}: time is not a number at sample {int(np.argmin(np.isfinite(self.time)))}; rewrite the time column"
            )
        steps = np.diff(self.time)
        dt = np.median(steps)
        if not dt > 0:
            raise RecordingError(
                f"{self.name}: time does not increase at sample {int(np.argmin(steps)) + 1}; sort the rows or mend the clock"
            )
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
        """Name of the driving channel: "current", "field" or "voltage"; of a sensor's calibration "reference", the known displacement."""
        return next((c for c in ("current", "reference", "field", "voltage") if c in self.channels), "field")

    def frequency(self) -> float | None:
        """Fundamental of the drive, Hz; None where less than 0.9 of a period is recorded or nothing repeats."""
        return self._frequency

    @functools.cached_property
    def _frequency(self) -> float | None:
        return fundamental(np.asarray(self.channels[self.drive], float), self.dt, self._header_frequency())

    def _header_frequency(self) -> float | None:
        stated = self.origin.get("metadata", {}).get("frequency_Hz")
        try:
            return float(stated) if 0 < float(stated) < np.inf else None
        except (TypeError, ValueError):
            return None

    def contradicted_frequency(self) -> float | None:
        """The frequency that the header states, Hz, where the drive repeats at another; None where they agree."""
        stated, found = self._header_frequency(), self.frequency()
        if stated is None or found is None or abs(stated - found) < max(0.5 / self.duration, 0.03 * found):
            return None
        return stated

    def periods(self) -> float:
        """How many periods were recorded (0 where aperiodic)."""
        f = self.frequency()
        return 0.0 if f is None else len(self.time) * self.dt * f

    @property
    def n_samples(self) -> int:
        """Samples a channel."""
        return len(self.time)

    @property
    def duration(self) -> float:
        """s, the step after the last sample included."""
        return self.n_samples * self.dt

    @property
    def is_periodic(self) -> bool:
        """Whether the drive repeats."""
        return self.frequency() is not None

    def period_samples(self) -> float | None:
        """Samples a period, not rounded; None where aperiodic."""
        f = self.frequency()
        return None if f is None else 1.0 / (f * self.dt)

    def repeats(self, channel: str) -> np.ndarray:
        """Whole periods of a channel at common phases, SI, (periods, samples a period); (0, 0) where aperiodic.

        Cubic splines where the period does not divide the sampling.
        """
        values, per = np.asarray(self.channels[channel], float), self.period_samples()
        if per is None:
            return np.zeros((0, 0))
        count, width = int(np.floor(len(values) / per + 1e-6)), int(round(per))  # here the last phase of each must have been sampled
        if abs(per - width) * count < 1e-3:
            return values[: count * width].reshape(count, width)
        from scipy.interpolate import CubicSpline

        at = per * (np.arange(count)[:, None] + np.arange(width) / width)
        return CubicSpline(np.arange(len(values)), values)(np.minimum(at, len(values) - 1))

    def repeat_noise(self, channel: str) -> float | None:
        """Noise rms of a channel by what its periods differ, SI; None with less than two periods. Drift counts as noise."""
        blocks = self.repeats(channel)
        if len(blocks) < 2:
            return None
        return float(np.sqrt(np.mean(np.var(blocks, axis=0, ddof=1))))

    def noise_is_a_guess(self, channel: str) -> bool:
        """Whether nothing tells the noise of a channel: less than two whole periods, and no rms in `noise`."""
        per = self.period_samples()
        return not self.noise.get(channel) and (per is None or whole_periods(self.n_samples, per) < 2)


def whole_periods(samples: int, per_period: float) -> int:
    """How many periods of so many samples a record holds; one that lacks less than a sample of its end is whole: where periods do
    not divide the sampling, four of them end between two samples."""
    return int(np.floor((samples + 1 - ALL_BUT_A_SAMPLE) / per_period))


NO_ANSWER = "the {channel} does not follow the {drive}: its periods share no more than noise does; check the wiring and the column"


def stray_samples(recording: Recording) -> tuple[int, str]:
    """How many single samples stood far off and were put where the other periods are when it was read, and of which channels."""
    metadata = recording.origin.get("metadata", {})
    number = metadata.get("stray_samples", 0)
    number = int(number) if isinstance(number, (int, float)) and 0 < number < 1e9 else 0
    return number, str(metadata.get("stray_channels", "")) if number else ""


def follows_nothing(recording: Recording, channel: str) -> bool:
    """Whether the periods of a channel share no more than independent noise would; False with less than two periods."""
    blocks = recording.repeats(channel)
    if len(blocks) < 2:
        return False
    blocks = blocks - blocks.mean(axis=1, keepdims=True)  # a drift is another matter
    shared, noise = float(np.var(blocks.mean(axis=0))), float(np.mean(np.var(blocks, axis=0, ddof=1)))
    return shared < (1 + 6 * np.sqrt(2 / blocks.shape[1])) * noise / len(blocks)


def refuse_constant(name: str, channel: str, values: np.ndarray):
    """Raise `RecordingError` where a channel, (time,), never changes."""
    if np.ptp(values) == 0:
        raise RecordingError(f"{name}: {channel} never changes ({values[0]:.6g}); check the wiring or the column")


def fundamental(x: np.ndarray, dt: float, hint=None) -> float | None:
    """The repetition frequency of a signal to sub-sample precision, Hz; None where it does not repeat.

    From the autocorrelation, then refined by least squares of the strongest harmonics over the whole record (periods need
    not divide the record). `hint`, Hz: where the search begins, too; it is left where the signal repeats otherwise.
    """
    n = len(x)
    x = x - x.mean()
    if np.ptp(x) == 0:
        return None
    found = _repetition(x, dt)
    if not hint:
        return found
    stated = float(hint)
    if n * dt * stated < 0.9:  # less than one period, unless it is seen to repeat
        return found if found is not None and n * dt * found > 1.2 else None
    if n * dt * stated <= 1.2 and (found is None or abs(found / stated - 1) < 0.03):
        return stated
    refined = _refine(x, dt, stated, 0.25 / (n * dt)) if n * dt * stated > 1.2 else stated
    power = float(x @ x)
    left = _leftover(x, dt, refined)(refined) + 1e-12 * power
    if found is None:
        return refined if left < 0.5 * power and (n * dt * refined < 2 or _returns(x, 1 / (refined * dt))) else None
    left_else = _leftover(x, dt, found)(found) + 1e-12 * power
    # a longer period must show in the signal, as a modulation does; a shorter one must leave no more of it
    agrees = abs(refined - found) * n * dt < 0.5
    return refined if agrees or left < 0.3 * left_else or (refined > found and left < 1.2 * left_else) else found


ALL_BUT_A_SAMPLE = 1e-3  # of a sample, by which less than one must be lacking
UNLIKE = 2e-3  # of a drive's power, by which its periods may differ: where they do by more, they may be parts of longer ones, as of two tones of like pitch


def _repetition(x, dt):
    """The frequency at which a signal of zero mean repeats by its autocorrelation, Hz, or None."""
    n = len(x)
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
            # the first peak as high as the highest, but for noise and for half a sample's shift
            slack = min(0.02, 1e-3 + 0.3 * (1 - float(correlation[1])) + 2 * (1 - min(float(best), 1.0)))
            peaks = np.flatnonzero((tail[1:-1] >= tail[:-2]) & (tail[1:-1] >= tail[2:]) & (tail[1:-1] > best - slack)) + 1
            if len(peaks):
                lag = below[0] + peaks[0]
                found = _refine(x, dt, 1.0 / (lag * dt), 1.0 / (lag**2 * dt))
                unlike = 2 * lag >= n or _leftover(x, dt, found)(found) > UNLIKE * float(x @ x)
                return _better(x, dt, found) if unlike and _closes(x) else found
    return 1.0 / (n * dt) if _closes(x) else None


def _returns(x, per) -> bool:
    """Whether a signal of zero mean looks like itself a period of `per` samples later."""
    n = len(x)
    later = np.interp(np.arange(n - int(per) - 1) + per, np.arange(n), x)
    now = x[: len(later)]
    return bool(now @ later > 0.5 * np.sqrt((now @ now) * (later @ later)))


def _closes(x) -> bool:
    """Whether a signal may be one period alone: it closes on itself, in value and in slope (half a sine does in value)."""
    n = len(x)
    e = max(1, n // 40)
    seam, bends = x[e] - 2 * x[0] + x[n - e], x[2 * e :] - 2 * x[e:-e] + x[: -2 * e]
    return bool(abs(x[0] - x[-1]) < 4 * np.abs(np.diff(x)).max() and abs(seam) < 3 * np.abs(bends).max())


def _better(x, dt, found):
    """The shortest period, longer than that of `found`, Hz, of which the record holds one, two or three (more of them show in its
    autocorrelation), where its harmonics leave far less of x; else `found`."""
    whole = 1.0 / (len(x) * dt)

    def left(f):
        return _leftover(x, dt, f)(f) + 1e-12 * float(x @ x)

    most = 0.3 * left(found)
    return next((k * whole for k in range(int(np.clip(found / whole / 1.5, 1, 3)), 0, -1) if left(k * whole) <= most), found)


def _leftover(x, dt, f, most: int = 5):
    """A function of a frequency near f (Hz): what the strongest harmonics of f, `most` of them, leave of x; `orders` says which.

    The strongest lines are used, not the first ones: a modulated sine has its power far above its fundamental.
    """
    n = len(x)
    t = dt * np.arange(n)
    orders = np.arange(1, max(2, int(min(60, 0.4 / (f * dt))) + 1))
    strength = np.array([abs(np.dot(x, np.exp(-2j * np.pi * h * f * t))) for h in orders])
    orders = orders[np.argsort(-strength, kind="stable")[:most]]
    orders = orders[strength[orders - 1] > 0.02 * strength.max()]

    def leftover(freq):
        angle = 2 * np.pi * freq * t
        design = np.stack([np.ones(n)] + [g(h * angle) for h in orders for g in (np.cos, np.sin)])
        coefficients = np.linalg.solve(design @ design.T + 1e-12 * n * np.eye(len(design)), design @ x)
        return np.sum((x - coefficients @ design) ** 2)

    leftover.orders = orders
    return leftover


def _least(leftover, f, width) -> float:
    """The frequency near f, Hz, that leaves least, by parabolas."""
    for _ in range(10):
        cost = np.array([leftover(v) for v in (f - width, f, f + width)])
        bend = cost[0] - 2 * cost[1] + cost[2]
        shift = 0.5 * (cost[0] - cost[2]) / bend * width if bend > 0 else width * np.sign(cost[0] - cost[2])
        f += float(np.clip(shift, -width, width))
        width *= 0.4
    return f


def _refine(x, dt, f, reach):
    """The f within `reach` (Hz) whose strongest harmonics leave least of x: a scan, then parabolas."""
    n, leftover = len(x), _leftover(x, dt, f)
    orders = leftover.orders
    step = 0.15 / (n * dt * orders.max())
    around = f + step * np.arange(-int(np.ceil(reach / step)), int(np.ceil(reach / step)) + 1)
    around = around[around > 0.5 * f]
    f = float(around[np.argmin([leftover(v) for v in around])])
    f = _least(leftover, f, step)
    every = _leftover(x, dt, f, 40)
    if len(every.orders) > len(orders):  # of a multisine, whose other lines draw the strongest ones off
        f = _least(every, f, step)
    # a record that closes within a hundredth of a sample is taken to close
    samples = 1 / (f * dt)
    nearest = round(samples * 200) / 200
    return 1.0 / (nearest * dt) if abs(samples - nearest) < 1e-4 * samples / max(n / samples, 1) else f


def load_recordings(paths, bench) -> list[Recording]:
    """Read files (CSV, NetCDF, .mat, acquisition logs) as the bench maps their columns; see `readers`."""
    from .readers import load_recordings as load

    return load(paths, bench)
