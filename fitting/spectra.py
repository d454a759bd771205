"""A recording in harmonics: drive lines, the reading's harmonics, and the noise between them.

A record of whole periods is reduced to its reading at the harmonics 0..H of the fundamental (least squares, so that
periods need not divide the sampling), its drive to the significant lines, and everything else to a noise spectrum
S(f) = white + flicker/f (or /f^2), estimated from the bins between the harmonics of all recordings.
"""

import dataclasses

import numpy as np
from scipy.optimize import minimize

from magjax.recording import whole_periods

HARMONICS = 40
ON_LINE = 0.6  # of the spacing that a record resolves, within which a tone stands on a line
DRIFT_ZERO = 0.25  # of a drift's size: where it had begun is not known
LOW_ORDERS = 10  # of a converter's integral nonlinearity
LIKELIER = 4.0  # logarithm of a likelihood, by which another law of the noise must be the better


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """One recording reduced to lines. SI; phases refer to the first sample.

    `frequency`: fundamental, Hz; `periods`: whole periods used; `samples`: used; `dt`: s; `drive`: complex Fourier
    coefficients of the drive, 0..; `reading`: those of the reading, 0..HARMONICS; `between_f`, `between_power`:
    frequencies (Hz) and periodogram of the reading between the harmonics (unit^2 per bin as variance of one
    coefficient times samples); `residue`: reading less its harmonics, (samples,).
    """

    name: str
    frequency: float
    periods: int
    samples: int
    dt: float
    drive: np.ndarray
    reading: np.ndarray
    between_f: np.ndarray
    between_power: np.ndarray
    residue: np.ndarray
    peak_to_peak: float
    drive_noise: float
    given_noise: float | None = None
    noise: object = None
    systematic: np.ndarray | None = None  # what the converters leave in each reading line, deviation of its parts
    gain_accuracy: float = 0.0  # the reading's scale in this recording, relative standard deviation
    hum: tuple[tuple[float, float], ...] | None = None  # frequency, Hz, and amplitude of tones taken out where they can be told
    drift: float = 0.0  # size of what was taken out of the reading as a drift of this recording alone
    zero: float = 0.0  # deviation of a zero that this recording has for itself
    start: np.ndarray | None = None  # decaying motion of an unsettled start, taken out of the reading, (samples,)

    @property
    def noise_rms(self) -> float:
        """Rms of what lies between the harmonics, unit of the reading."""
        scale = self.samples / max(self.samples - 2 * len(self.reading), 1)
        return float(np.sqrt(np.mean(self.residue**2) * scale))

    def drive_at(self, phases: np.ndarray) -> np.ndarray:
        """The drive at phases (cycles) of one period."""
        return evaluate_lines(self.drive, phases)


def reading_range(spectra) -> tuple[float, float]:
    """The lowest and the highest reading of some recordings."""
    ends = [float(s.reading[0].real) + side * s.peak_to_peak / 2 for s in spectra for side in (-1, 1)]
    return min(ends, default=0.0), max(ends, default=0.0)


def evaluate_lines(lines: np.ndarray, phases: np.ndarray) -> np.ndarray:
    """The real signal with Fourier coefficients `lines` (0..) at phases in cycles."""
    turn, value = np.exp(2j * np.pi * phases), np.zeros(len(phases), complex)
    for line in np.trim_zeros(lines[1:], "b")[::-1]:  # a polynomial in the turn: one exponential for all
        value += line
        value *= turn
    return lines[0].real + 2 * value.real


def fit_lines(signal: np.ndarray, phases: np.ndarray, count: int):
    """Fourier coefficients 0..count at the given phases (cycles) by least squares, and what they leave."""
    n = len(signal)
    whole = phases[-1] + (phases[1] - phases[0])
    if abs(whole - round(whole)) < 1e-9:
        steps = round(whole)
        spectrum = np.fft.rfft(signal) / n
        lines = np.zeros(count + 1, complex)
        available = spectrum[: count * steps + 1 : steps]
        lines[: len(available)] = available
    else:
        angle = 2 * np.pi * np.outer(np.arange(1, count + 1), phases)
        design = np.concatenate([np.ones((1, n)), np.cos(angle), np.sin(angle)])
        solution = np.linalg.solve(design @ design.T, design @ signal)
        lines = np.concatenate([solution[:1], 0.5 * (solution[1 : count + 1] - 1j * solution[count + 1 :])])
    return lines, signal - evaluate_lines(lines, phases)


def reduce_recording(recording, drive: str, output: str, harmonics: int = HARMONICS, columns=None) -> Spectrum:
    """The `Spectrum` of a periodic recording: `drive` and `output` name its channels; `columns`: the bench's."""
    columns = columns or {}
    dt, frequency = float(recording.dt), float(recording.frequency())
    x, y = (np.asarray(recording.channels[c], float) for c in (drive, output))
    per_period = 1.0 / (frequency * dt)
    periods = max(1, whole_periods(len(x), per_period))
    samples = min(len(x), int(round(periods * per_period)))
    x, y = x[:samples], y[:samples]
    # phases that close exactly where the samples do
    divides = abs(periods * per_period - samples) < 1e-3
    phases = np.arange(samples) * (periods / samples if divides else frequency * dt)
    count = min(harmonics, int(per_period / 2) - 1)
    lines, residue = fit_lines(y, phases, count)
    drive_lines, drive_residue = fit_lines(x, phases, int(min(4 * harmonics, per_period / 2 - 1)))
    drive_step = quantum(np.ptp(x), columns.get(drive, {}))
    drive_lines, drive_noise = significant_lines(drive_lines, drive_residue, periods, drive_step)
    spectrum = np.abs(np.fft.rfft(residue)) ** 2 / samples
    f = np.fft.rfftfreq(samples, dt)
    order = f * (1 / frequency)
    keep = (f > 0) & (np.abs(order - np.round(order)) > 0.5 / periods - 1e-9) if periods > 1 else order > count + 0.5
    if not divides:
        keep &= np.abs(order - np.round(order)) > 0.3
    return Spectrum(
        recording.name, frequency, periods, samples, dt, drive_lines, lines, f[keep], spectrum[keep], residue,
        float(np.ptp(y)), drive_noise, (recording.noise or {}).get(output),
        systematic=systematic_deviations(lines, drive_lines, frequency, drive_step, columns.get(output, {}), float(np.ptp(y))),
        gain_accuracy=float(columns.get(output, {}).get("gain_accuracy", 0.0)), hum=recording.origin.get("hum"),
        drift=float(recording.origin.get("drift", 0.0)),
        zero=float(recording.origin.get("zero", 0.0)),
    )  # fmt: skip


def quantum(peak_to_peak: float, column) -> float:
    """Rms of a converter's rounding, unit of the channel: (peak to peak / 2^bits) / sqrt(12), 0 where no bits are stated."""
    return float(peak_to_peak) / 2 ** column["bits"] / np.sqrt(12) if "bits" in column else 0.0


def systematic_deviations(lines, drive_lines, frequency, drive_step, column, peak_to_peak):
    """What rounding and its nonlinearity leave in each reading line whatever the averaging, or None.

    A converter's error repeats with the signal, so repeats do not show it: its rms is shared by the first ten orders and
    fades above, as integral nonlinearity does. An error of the drive passes on by the slope of the loop; that of an emf
    by the integral.
    """
    order = np.arange(len(lines))
    if "emf_turns" in column:
        pace = 2 * np.pi * frequency * np.maximum(order, 1)
        rate = evaluate_lines(lines * pace * np.where(order > 0, 1j, 0), np.arange(512) / 512)
        step = quantum(np.ptp(rate), column) / pace
    else:
        step = np.full(len(lines), quantum(peak_to_peak, column))
    slope = abs(lines[1]) / max(abs(drive_lines[1]), 1e-300)
    share = np.sqrt(2 / LOW_ORDERS) * np.minimum(1.0, (LOW_ORDERS / np.maximum(order, 1)) ** 2)
    total = share * np.hypot(step, slope * drive_step)
    return total / 2 if total.any() else None


def significant_lines(lines: np.ndarray, residue: np.ndarray, periods: int, step: float = 0.0):
    """Drive lines above their noise, others zero; and the rms of the noise.

    The noise of a line is that of the quieter half of all lines: a raw noisy current would feed its noise to the model;
    `step`: rms of the converter's rounding, below which a line is the converter's own.
    """
    power = np.abs(lines) ** 2
    floor = np.median(power[len(power) // 2 :]) / np.log(2) if len(power) > 8 else 0.0
    if periods > 1 and len(residue) > 8:
        floor = max(floor, np.mean(residue**2) / len(residue))
    keep = power > 25 * floor + 1e-10 * power[1:].max() + step**2
    keep[:2] = True
    return np.where(keep, lines, 0.0), float(np.sqrt(floor * len(residue)))


@dataclasses.dataclass(frozen=True)
class Noise:
    """S(f) = white + flicker / f^slope: variance a sample, unit^2; slope 1, or 2 for an integrated channel."""

    white: float
    flicker: float
    slope: int = 1

    def density(self, f):
        """Variance per sample of noise at frequency f, Hz."""
        return self.white + self.flicker / np.maximum(f, 1e-9) ** self.slope

    @property
    def rms(self) -> float:
        """White part, rms."""
        return float(np.sqrt(self.white))


def estimate_noise(spectra, quantum: float = 0.0) -> Noise:
    """White and flicker noise by Whittle's likelihood over the bins between the harmonics, pooled."""
    f = np.concatenate([s.between_f for s in spectra])
    power = np.concatenate([s.between_power for s in spectra])
    given = [s.given_noise for s in spectra if s.given_noise]
    if len(f) < 20:
        white = np.mean(np.square(given)) if given else max(quantum**2 / 12, (1e-4 * spectra[0].peak_to_peak) ** 2)
        return Noise(float(white), 0.0)
    white0 = max(np.median(power) / np.log(2), 1e-300)
    f0 = float(np.median(f))
    flat = float(np.mean(power))
    best, likelihood = Noise(flat, 0.0), np.log(flat) + 1.0
    for slope in (1, 2):

        def whittle(theta, slope=slope):
            S = white0 * (np.exp(theta[0]) + np.exp(theta[1]) * (f0 / f) ** slope)
            return np.mean(np.log(S) + power / S)

        for start in ([0.0, -4.0], [-3.0, 0.0]):
            found = minimize(whittle, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-7, "maxiter": 400})
            if (likelihood - found.fun) * len(f) > 4:  # the colour earns its place
                white, flicker = np.exp(found.x) * white0
                best, likelihood = Noise(float(white), float(flicker * f0**slope), slope), found.fun
    return dataclasses.replace(best, white=max(best.white, quantum**2 / 12))


def pooled_noise(spectra):
    """The noise of all recordings by one law, a function from a spectrum to its `Noise`: the colour goes by frequency, or,
    where that is likelier, by frequency over the sampling rate, so that it moves with the rate (noise of a converter or of
    its clock; noise made record by record)."""
    common = estimate_noise(spectra)
    moving = estimate_noise([dataclasses.replace(s, between_f=s.between_f * s.dt) for s in spectra])

    def moved(s):
        return dataclasses.replace(moving, flicker=moving.flicker / s.dt**moving.slope)

    likelier = unlikeliness(spectra, map(moved, spectra)) < unlikeliness(spectra, [common] * len(spectra)) - LIKELIER
    return moved if likelier else lambda s: common


def unlikeliness(spectra, noises) -> float:
    """Minus the logarithm of Whittle's likelihood of what lies between the harmonics, a noise for each recording."""
    densities = [noise.density(s.between_f) for s, noise in zip(spectra, noises, strict=True)]
    return sum(float(np.sum(np.log(d) + s.between_power / d)) for s, d in zip(spectra, densities, strict=True))


def with_noise(spectra) -> tuple:
    """The spectra with their noise: by one law for all, or each its own where the bins between the harmonics say that they differ.

    They do where their likelihood rises by 40 a recording, or by 12 with levels more than twofold apart (noise in
    proportion to loops of different size): pooling these would double the errors of the parameters. What is left of
    drifts that differ, differs too: there 6 are enough.
    """
    noises = list(map(pooled_noise(spectra), spectra))
    if all(len(s.between_f) >= 40 for s in spectra):
        own = [estimate_noise([s]) for s in spectra]
        gain = unlikeliness(spectra, noises) - unlikeliness(spectra, own)
        levels = [float(np.mean(s.between_power)) for s in spectra]
        least = 6 if any(s.drift for s in spectra) else 40
        if gain > least * len(spectra) or (gain > 12 * len(spectra) and max(levels) > 2 * min(levels)):
            noises = own
    return tuple(dataclasses.replace(s, noise=n) for s, n in zip(spectra, noises, strict=True))


def line_deviations(spectrum: Spectrum, noise: Noise) -> np.ndarray:
    """Standard deviation of the real (and of the imaginary) part of each reading line, unit; line 0 is real alone."""
    count = len(spectrum.reading)
    lowest = spectrum.frequency / max(spectrum.periods, 1)
    f = np.maximum(np.arange(count) * spectrum.frequency, lowest)
    variance = noise.density(f) / spectrum.samples
    for tone, amplitude in spectrum.hum or ():
        # lines on the hum carry it with an unknown phase, lines beside it what its removal left: they count for less
        away = np.abs(np.arange(count) * spectrum.frequency - tone)
        left = np.where(away < ON_LINE * lowest, 1.0, 0.25 * np.minimum(1.0, lowest / (np.pi * np.maximum(away, lowest))))
        variance = variance + (left * amplitude) ** 2 / 4
    variance[0] += (DRIFT_ZERO * spectrum.drift) ** 2 + spectrum.zero**2
    variance = np.where(np.arange(count) == 0, variance, 0.5 * variance)
    return np.sqrt(variance if spectrum.systematic is None else variance + spectrum.systematic**2)


def hum_part(errors: np.ndarray, spectrum: Spectrum) -> np.ndarray:
    """As much of the errors of lines 0.. of the reading as may be hum that stands on them, whose phase nothing tells there."""
    lowest, sizes = spectrum.frequency / max(spectrum.periods, 1), np.zeros(len(errors))
    for tone, amplitude in spectrum.hum or ():
        sizes[np.abs(np.arange(len(errors)) * spectrum.frequency - tone) < ON_LINE * lowest] += amplitude / 2
    return errors * np.minimum(1.0, sizes / np.maximum(np.abs(errors), 1e-300))


def gain_rows(spectra, deviations):
    """The whitening of uncertain scales: unit direction of each recording's whitened reading, and what to take off.

    Relative errors g of the scales, whose mean over the recordings is zero by convention (the first of all scales is the
    bench's word), add U G U' to the covariance, G = g_i g_j (1_ij - 1/n). Its inverse root acts on the components along the
    readings alone: (recordings, lines) complex, and the matrix I - C^(-1/2), (recordings, recordings).
    """
    rows, sizes = [], []
    for s, deviation in zip(spectra, deviations, strict=True):
        row = np.zeros(len(deviation), complex)
        row[: len(s.reading)] = s.reading[: len(deviation)]
        row = row / deviation
        row[0] = row[0].real
        sizes.append(np.sqrt(np.sum(np.abs(row) ** 2)))
        rows.append(row / max(sizes[-1], 1e-300))
    n = len(rows)
    spread = np.asarray([s.gain_accuracy for s in spectra]) * np.asarray(sizes)
    values, vectors = np.linalg.eigh(np.eye(n) + spread[:, None] * (np.eye(n) - 1 / n) * spread)
    return np.stack(rows), np.eye(n) - (vectors / np.sqrt(values)) @ vectors.T
