"""A concealed bench: commands in, settled readings out. All recordings march side by side, each from the same start memory."""

import numpy as np

from .coil import C0, FieldSolver
from .density import PlayDensity
from .rod import displacement
from .sensor import amplifier, reading, sleeve
from .strain import FULL, M_S, free_displacement

FINE = 1000  # steps a period
MU0 = 4e-7 * np.pi


def command_of(drive, steps=FINE):
    """One period of the command, A: offset, amplitude and `extra` (order, share, angle) of a drive."""
    phase = 2 * np.pi * np.arange(steps) / steps
    signal = np.sin(phase) if not drive.get("silent") else np.zeros(steps)
    for order, share, angle in drive.get("extra", ()):
        signal = signal + share * np.sin(order * phase + angle)
    return drive["offset"] + drive["amplitude"] * signal


class ConcealedBench:
    """`truth`: R_eddy, f0, xi, H_bias; `effects`: name -> strength; `density`: kind; `start`: demagnetized, negative, positive."""

    def __init__(self, truth, effects, density, start, rng, radii=None):
        self.truth, self.effects, self.start = truth, dict(effects), start
        self.density = PlayDensity(density, 0.92 * M_S, rng, **({} if radii is None else {"radii": radii}))

    def without(self):
        """The same bench with nothing concealed."""
        bare = object.__new__(ConcealedBench)
        bare.truth, bare.effects, bare.start, bare.density = self.truth, {}, self.start, self.density
        return bare

    def run(self, drives, steps=FINE, settle=6):
        """Dictionary of one settled period, each (recordings, steps): reading (m), current (A), M and H (A/m)."""
        frequency = np.array([float(d["frequency"]) for d in drives])
        h = 1 / (frequency * steps)
        command = np.array([command_of(d, steps) for d in drives])
        current = amplifier(command, frequency, self.effects)
        applied = self.truth["H_bias"] + C0 * sleeve(current, frequency, self.effects)
        solver = FieldSolver(self.density, self.truth["R_eddy"], self.effects)
        M, H = solver.solve(applied, h, self.start, settle=settle)
        y = displacement(free_displacement(M, H, self.effects), M, frequency, self.truth, self.effects)
        stress = self.effects.get("stress_feedback", 0.0)  # Pa at full strain, by waveform relaxation
        for _ in range(4 if stress else 0):
            sigma = -stress * y / FULL
            M, H = solver.solve(applied, h, self.start, 3 * 1.313e-3 * sigma / (MU0 * M_S**2), settle)
            y = displacement(free_displacement(M, H, self.effects), M, frequency, self.truth, self.effects)
        turns = y.shape[1] // steps  # two where the period is doubled
        current = np.tile(current, turns)
        y = reading(y, current, frequency / turns, self.effects)
        return {"reading": y, "current": current, "command": np.tile(command, turns), "M": M, "H": H, "turns": turns}
