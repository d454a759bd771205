"""Hysteresis of the concealed benches: play operators with a tabulated density, many recordings side by side.

M = M_low + sum_r w_r (F_r(p_r) - F_r(bottom)), p_r the play of radius r (Krasnosel'skii and Pokrovskii; Brokate and
Sprekels 1996), F_r the integral of the density over the mean field at half-width r.
"""

import numpy as np

LINES = 1200


class Plays:
    """A bench's hysteresis. `low`, `high`: fields that the density covers, A/m; `saturation`: A/m.

    `kind`: "smooth" (Gaussian x Lorentzian), "lobes" (two of them), "heavy" (log-normal x Student), "rough" (ripple that
    does not factorise).
    """

    def __init__(self, kind, low, high, saturation, rng, radii=240):
        self.low, self.high = low, high
        half = 0.5 * (high - low)
        self.radii = half * ((np.arange(radii) + 0.5) / radii) ** 1.5
        edges = half * (np.arange(radii + 1) / radii) ** 1.5
        self.s = np.linspace(low, high, LINES)
        S, R = np.meshgrid(self.s, self.radii)
        u, v = (S - 0.5 * (low + high)) / half, R / half
        density = getattr(self, "_" + kind)(u, v, rng)
        density = np.where(np.abs(S - 0.5 * (low + high)) <= half - R, density, 0.0) * np.diff(edges)[:, None]
        step = self.s[1] - self.s[0]
        total = density.sum() * step
        self.density = 2 * saturation * density / total
        self.integral = np.concatenate([np.zeros((radii, 1)), np.cumsum(0.5 * (self.density[:, 1:] + self.density[:, :-1]) * step, axis=1)], axis=1)
        self.saturation = saturation

    @staticmethod
    def _smooth(u, v, rng):
        centre, width, coercive = rng.uniform(-0.5, -0.2), rng.uniform(0.35, 0.6), rng.uniform(0.08, 0.2)
        return np.exp(-0.5 * ((u - centre) / width) ** 2) / (1 + (v / coercive) ** 2)

    @classmethod
    def _lobes(cls, u, v, rng):
        second = np.exp(-0.5 * ((u - rng.uniform(0.0, 0.3)) / 0.2) ** 2 - 0.5 * ((v - rng.uniform(0.15, 0.3)) / 0.1) ** 2)
        return cls._smooth(u, v, rng) + rng.uniform(0.3, 0.8) * second

    @staticmethod
    def _heavy(u, v, rng):
        centre, width = rng.uniform(-0.5, -0.2), rng.uniform(0.3, 0.5)
        mode, spread = rng.uniform(0.1, 0.2), rng.uniform(0.5, 0.8)
        student = (1 + ((u - centre) / width) ** 2 / 3) ** -2
        return student * np.exp(-0.5 * (np.log((v + 1e-3) / mode) / spread) ** 2) / (v + 0.05)

    @classmethod
    def _rough(cls, u, v, rng):
        ripple = np.zeros_like(u)
        for _ in range(12):
            a, b = rng.uniform(-9, 9), rng.uniform(4, 16)
            ripple += rng.normal() * np.cos(a * u + b * v + rng.uniform(0, 6.3))
        return cls._lobes(u, v, rng) * np.clip(1 + rng.uniform(0.25, 0.5) * ripple / 2.5, 0.05, None)

    def start(self, fields, state):
        """Plays of every recording led to `fields` from a start state: (recordings, radii)."""
        H = np.asarray(fields)[:, None]
        if state == "saturated":
            plays = np.full((len(H), len(self.radii)), self.low) + self.radii
        else:  # demagnetised about the middle
            plays = np.full((len(H), len(self.radii)), 0.5 * (self.low + self.high))
        return self.move(plays, H[:, 0])

    def move(self, plays, H):
        """Plays after the field has moved."""
        return np.clip(plays, H[:, None] - self.radii, H[:, None] + self.radii)

    def _look(self, table, plays):
        place = np.clip((plays - self.low) / (self.s[1] - self.s[0]), 0, LINES - 1.000001)
        k = place.astype(int)
        row = np.arange(len(self.radii))
        share = place - k
        return (1 - share) * table[row, k] + share * table[row, k + 1]

    def magnetization(self, plays):
        """M, A/m, of every recording."""
        return self._look(self.integral, plays).sum(axis=1) - self.saturation

    def slope(self, plays, before, H):
        """dM/dH at H: of the plays that the field drags."""
        dragged = np.abs(plays - before) > 0
        return (self._look(self.density, plays) * dragged).sum(axis=1)
