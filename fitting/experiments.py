"""The next experiment: the recording that best tells rivals apart, within the bench's limits."""

import numpy as np
from scipy.special import ndtr

from magjax.errors import MagjaxError
from magjax.simulate import simulate

CHANNELS = {
    frozenset(("source", "sensor")): "the coil current by a shunt, on the same clock as the displacement",
    frozenset(("source", "mechanics")): "the coil current by a shunt, on the same clock as the displacement",
    frozenset(("mechanics", "sensor")): "a calibration of the sensor (or the resonance again with a known mass added)",
    frozenset(("coil", "hysteresis")): "the flux density by a pick-up coil round the rod",
    frozenset(("magnetostriction", "sensor")): "a calibration of the sensor over its range",
}


def next_experiment(trials, spectra, bench, noise_rms: float) -> dict | None:
    """A sine of the menu that separates the best pair of rivals, and the channel that would settle it outright."""
    if len(trials) < 2:
        return None
    limit = float(bench.limits.get("current_A", bench.limits.get("field_A_per_m", 1.0)))
    amplitudes = [abs(2 * s.drive[1]) for s in spectra]
    frequencies = np.array([s.frequency for s in spectra])
    menu_f = np.unique(np.round(np.concatenate([[0.5 * frequencies.min()], [2 * frequencies.max(), 1.5 * frequencies.max()], frequencies]), 3))
    best = None
    phase = 2 * np.pi * np.arange(250) / 250
    for f in menu_f:
        for A in (0.3 * max(amplitudes), min(max(amplitudes), limit)):
            offset = float(spectra[0].drive[0].real)
            drive = offset + A * np.sin(phase)
            try:
                curves = [np.asarray(simulate(t.result.actuator, drive, 1 / (250 * f), periodic=True).reading) for t in trials[:3]]
            except MagjaxError:
                continue
            samples = 4000
            apart = [
                np.sqrt(samples * np.mean((a - b) ** 2)) / noise_rms for i, a in enumerate(curves) for b in curves[i + 1 :]
            ]  # fmt: skip
            if best is None or min(apart) > best[0]:
                best = (min(apart), f, A, offset)
    if best is None:
        return None
    apart, f, A, offset = best
    probability = float(ndtr(0.5 * apart))
    unit = "A" if bench.drive == "current" else "A/m"
    channel = None
    for i, a in enumerate(trials):
        for b in trials[i + 1 :]:
            channel = channel or CHANNELS.get(frozenset((a.candidate.block, b.candidate.block)))
    names = [t.name for t in trials]
    text = f"four settled periods of {A:.3g} {unit} at {f:.4g} Hz about {offset:.3g} {unit}"
    text += f": separates {names[0]} from {names[1]} with probability {min(probability, 0.99):.2f}"
    if channel:
        text += f"; better, record {channel}"
    return {
        "text": text,
        "drive": {"kind": "sine", "frequency_Hz": float(f), "amplitude": float(A), "offset": offset, "periods": 4},
        "channels": [channel] if channel else [bench.output],
        "separates": [[names[0], n, min(probability, 0.99)] for n in names[1:]],
    }
