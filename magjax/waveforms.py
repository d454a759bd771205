"""Drives to apply: biased sine, sweep set, decaying reversals, first-order reversal curves, multisine, modulated sine.

Each returns the current in A at uniform samples (a field in A/m serves as well: only the amplitude's unit changes);
`Drive` keeps time, values and what they are. NumPy only.
"""

import dataclasses

import numpy as np

from .errors import ConfigurationError


@dataclasses.dataclass(frozen=True)
class Drive:
    """A drive. `values`: A, (time,); `dt`: s; `frequency`: Hz of its repetition, None where it runs once; `name`."""

    values: np.ndarray
    dt: float
    frequency: float | None
    name: str

    @property
    def time(self) -> np.ndarray:
        """Sample times from zero, s."""
        return self.dt * np.arange(len(self.values))

    @property
    def duration(self) -> float:
        """s, the step after the last sample included."""
        return self.dt * len(self.values)

    @property
    def peak(self) -> float:
        """Largest absolute value, A: what a current limit is checked against."""
        return float(np.max(np.abs(self.values)))

    def within(self, limit: float) -> "Drive":
        """This drive; raises `ConfigurationError` where it passes `limit` (A)."""
        if self.peak > limit * (1 + 1e-12):
            raise ConfigurationError(
                f"drive {self.name} reaches {self.peak:.4g} where the limit is {limit:.4g}; lower its amplitude or offset"
            )
        return self


def _positive(**values):
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ConfigurationError(f"{name} = {value!r}; give a value above zero")


def _counts(**values):
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise ConfigurationError(f"{name} = {value!r}; give a whole number of one or more")


def sine(frequency, amplitude, offset=0.0, *, periods: int = 4, samples: int = 1000) -> Drive:
    """offset + amplitude sin(2 pi f t): frequency in Hz, amplitude and offset in A, `samples` a period.

    >>> sine(10, 0.5, 0.1, periods=1, samples=4).values.round(3)
    array([ 0.1,  0.6,  0.1, -0.4])
    """
    _positive(frequency=frequency, amplitude=amplitude)
    _counts(periods=periods, samples=samples)
    phase = 2 * np.pi * np.arange(samples) / samples
    one = offset + amplitude * np.sin(phase)
    return Drive(
        np.tile(one, periods),
        1 / (frequency * samples),
        float(frequency),
        f"sine {frequency:g} Hz, {amplitude:g} A about {offset:g} A",
    )


def sweep_set(frequencies, amplitudes, offsets=(0.0,), *, limit=None, periods: int = 4, samples: int = 1000) -> list[Drive]:
    """Biased sines over the grid, offsets innermost; points beyond `limit` (A, |offset| + amplitude) are refused."""
    drives = [sine(f, a, o, periods=periods, samples=samples) for f in frequencies for a in amplitudes for o in offsets]
    return drives if limit is None else [d.within(limit) for d in drives]


def decaying(frequency, amplitude, offset=0.0, *, decay: float = 0.9, floor: float = 0.01, samples: int = 1000) -> Drive:
    """A sine that dies out to the offset: demagnetizes. Each period's amplitude is `decay` times the last, down to `floor`.

    a(t) = amplitude decay^(f t), so that every reversal lies inside the one before it.
    """
    _positive(frequency=frequency, amplitude=amplitude)
    _counts(samples=samples)
    if not (0 < decay < 1 and 0 < floor < 1):
        raise ConfigurationError(f"decay = {decay!r} and floor = {floor!r} must lie between 0 and 1")
    periods = int(np.ceil(np.log(floor) / np.log(decay)))
    cycles = np.arange(samples * periods + 1) / samples
    values = offset + amplitude * decay**cycles * np.sin(2 * np.pi * cycles)
    return Drive(values, 1 / (frequency * samples), None, f"decaying {frequency:g} Hz from {amplitude:g} A about {offset:g} A")


def reversal_curves(low, high, count: int, rate, *, samples_per_curve: int = 500) -> Drive:
    """First-order reversal curves: from `high` down to each of `count` even levels and back up, by ramps of `rate` A/s.

    The reversal levels lie below `high` and end at `low`. Each ramp takes the samples its length needs at one step.
    """
    _positive(rate=rate)
    _counts(count=count, samples_per_curve=samples_per_curve)
    if not low < high:
        raise ConfigurationError(f"low = {low!r} must lie below high = {high!r}")
    levels = high - (high - low) * np.arange(1, count + 1) / count
    step = (high - low) / (samples_per_curve / 2)
    corners = np.concatenate([[high], np.stack([levels, np.full(count, high)], axis=1).ravel()])
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners)))])
    # a whole number of steps to every corner, so that each reversal is met exactly
    steps = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(np.diff(travelled) / step)).astype(int))])
    values = np.interp(np.arange(steps[-1] + 1), steps, corners)
    return Drive(values, travelled[-1] / rate / steps[-1], None, f"{count} reversal curves {low:g} .. {high:g} A")


def multisine(frequencies, amplitude, offset=0.0, *, periods: int = 4, samples: int = 2000) -> Drive:
    """Lines of equal strength at `frequencies` (Hz, whole multiples of their common base), scaled to the peak `amplitude`.

    Schroeder's phases, phi_k = -pi k (k - 1) / K, keep the crest low (M. R. Schroeder, IEEE Trans. Inf. Theory 16, 1970).
    """
    frequencies = np.asarray(list(frequencies), float)
    _positive(amplitude=amplitude)
    _counts(periods=periods, samples=samples)
    if len(frequencies) == 0 or not np.all(frequencies > 0):
        raise ConfigurationError("frequencies must be one or more values above zero")
    base = _common_base(frequencies)
    orders = np.round(frequencies / base).astype(int)
    if orders.max() > samples / 8:
        raise ConfigurationError(
            f"{samples} samples a period of {1 / base:.4g} s are too few for {frequencies.max():g} Hz; give samples = {8 * orders.max()} or more"
        )
    k = np.arange(1, len(orders) + 1)
    phases = -np.pi * k * (k - 1) / len(orders)
    t = np.arange(samples) / samples
    one = np.sum(np.cos(2 * np.pi * np.outer(orders, t) + phases[:, None]), axis=0)
    one *= amplitude / np.max(np.abs(one))
    name = f"multisine {', '.join(f'{f:g}' for f in frequencies)} Hz, {amplitude:g} A about {offset:g} A"
    return Drive(np.tile(offset + one, periods), 1 / (base * samples), base, name)


def _common_base(frequencies) -> float:
    """The largest frequency of which all are whole multiples (to a part in a million)."""
    scale = frequencies.min()
    for divisor in range(1, 1001):
        ratios = frequencies / (scale / divisor)
        if np.all(np.abs(ratios - np.round(ratios)) < 1e-6 * ratios):
            return float(scale / divisor)
    raise ConfigurationError(
        f"frequencies {', '.join(f'{f:g}' for f in frequencies)} Hz have no common base; choose multiples of one frequency"
    )


def modulated_sine(carrier, modulation, amplitude, depth=0.6, offset=0.0, *, periods: int = 4, samples: int = 2000) -> Drive:
    """offset + A (1 + depth cos(2 pi f_m t)) / (1 + depth) sin(2 pi f_c t): minor loops within the peak A.

    `carrier` (Hz) is a whole multiple of `modulation` (Hz), which is what repeats; `samples` a period of it.
    """
    _positive(carrier=carrier, modulation=modulation, amplitude=amplitude)
    _counts(periods=periods, samples=samples)
    ratio = carrier / modulation
    if abs(ratio - round(ratio)) > 1e-6 * ratio or round(ratio) < 2:
        raise ConfigurationError(
            f"carrier = {carrier:g} Hz must be a whole multiple, two or more, of modulation = {modulation:g} Hz"
        )
    if not 0 <= depth <= 1:
        raise ConfigurationError(f"depth = {depth!r} must lie between 0 and 1")
    if round(ratio) > samples / 8:
        raise ConfigurationError(
            f"{samples} samples a period are too few for the carrier; give samples = {8 * round(ratio)} or more"
        )
    t = np.arange(samples) / samples
    one = offset + amplitude * (1 + depth * np.cos(2 * np.pi * t)) / (1 + depth) * np.sin(2 * np.pi * round(ratio) * t)
    name = f"{carrier:g} Hz modulated at {modulation:g} Hz, {amplitude:g} A about {offset:g} A"
    return Drive(np.tile(one, periods), 1 / (modulation * samples), float(modulation), name)
