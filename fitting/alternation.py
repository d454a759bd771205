"""Period doubling: readings that repeat only after two periods of the drive.

No block of the model does that: a subharmonic needs an oscillator that is not linear (a rattling joint, an impact, a
parametric resonance), so it is put down to the mechanics. It is found before all else, taken out so that the rest of the
diagnosis can go on, and told with its size. Drift, transients and slow noise differ between periods of the same parity
too, and hum between the harmonics of one frequency only.
"""

import dataclasses

import numpy as np

from magjax.plausibility import si_unit
from magjax.words import sized

from .spectra import evaluate_lines

RATIO = 6.0  # mean square of the alternation over what noise leaves in it
RECORDINGS = 0.9  # of the recordings must show it: a hum falls between the harmonics of some


@dataclasses.dataclass(frozen=True)
class Alternation:
    """What alternates from period to period: `size` relative to the reading's departure from its mean with `stderr`,
    `share` of the alternation that this proportion and a constant explain, rms in the `unit` of the reading, recordings without it."""

    size: float
    stderr: float
    share: float
    rms: float
    unit: str
    ratio: float
    cleaned: tuple = dataclasses.field(repr=False)

    def told(self, found):
        """The verdict on recordings without it, as the verdict on the recordings as they are."""
        size = f"by {abs(self.size):.2g} of the motion" if self.share > 0.5 else f"by {sized(self.unit, self.rms)} rms"
        text = (
            f"every second period differs {size}: a subharmonic of the drive, which no effect of the catalogue makes. It asks for an oscillator "
            "that is not linear: look for play, rattle or impact in the mechanics."
        )
        text += f" Without it: {found.verdict.replace('_', ' ')}: {found.message}"
        unknown = {
            "block": "mechanics", "region": "every second period", "explained_share": 0.0, "amplitude": self.size, "stderr": self.stderr,
            "share": self.share, "rms": self.rms, "unit": self.unit,
        }  # fmt: skip
        return dataclasses.replace(found, verdict="unknown_at", message=text, unknown=unknown, data_problem=None)


def alternating(recordings, spectra, output: str) -> Alternation | None:
    """The alternation that nearly all recordings show, or None. Needs three periods of each."""
    seen, cleaned, top, bottom, power, left, error = [], [], 0.0, 0.0, 0.0, 0.0, 0.0
    for recording, s in zip(recordings, spectra, strict=True):
        if s.periods < 3:
            return None
        step = int(s.samples / s.periods)
        phases = np.arange(step) / step
        cycles = np.arange(s.samples) * s.dt * s.frequency
        residue = s.residue if s.start is None else s.residue + s.start[: s.samples]  # a decay may have taken part of it
        blocks = np.stack([np.interp(k + phases, cycles, residue) for k in range(s.periods)])
        even, odd = blocks[::2], blocks[1::2]
        pattern = 0.5 * (even.mean(axis=0) - odd.mean(axis=0))
        noise = np.mean((blocks[2:] - blocks[:-2]) ** 2) / 2 * (1 / len(even) + 1 / len(odd)) / 4
        seen.append(np.mean(pattern**2) / max(noise, 1e-300))
        wave = evaluate_lines(s.reading, phases)
        wave = wave - wave.mean()
        size = float(pattern @ wave) / float(wave @ wave)
        weight = float(wave @ wave) / noise
        top, bottom = top + weight * size, bottom + weight
        power, left, error = (
            power + float(pattern @ pattern),
            left + float(np.sum((pattern - pattern.mean() - size * wave) ** 2)),
            error + 1.0,
        )
        there = np.interp(cycles % 1.0, np.append(phases, 1.0), np.append(pattern, pattern[0]))
        alternate = np.zeros(len(recording.time))
        alternate[: s.samples] = np.where(np.floor(cycles + 1e-9) % 2 == 0, there, -there)
        channels = {**recording.channels, output: np.asarray(recording.channels[output], float) - alternate}
        cleaned.append(dataclasses.replace(recording, channels=channels))
    shown = np.mean(np.asarray(seen) > RATIO)
    if len(seen) < 2 or shown < RECORDINGS:
        return None
    rms = float(np.sqrt(power / sum(int(s.samples / s.periods) for s in spectra)))
    return Alternation(
        float(top / bottom), float(1 / np.sqrt(bottom)), float(1 - left / power), rms, si_unit(output), float(np.median(seen)), tuple(cleaned)
    )
