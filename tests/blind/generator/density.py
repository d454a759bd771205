"""Densities of the Preisach plane as a bundle of play operators, tabulated once a bench.

A relay with mean field s and half-width r is +1 while the play of radius r stands above s, so that
    M(t) = sum_r integral of w(r, s) sign(p_r(t) - s) ds = sum_r F_r(p_r(t)),
with F_r piecewise linear on a table (Brokate and Sprekels 1996). Fields in A/m; scaled coordinates u = s / SPAN, v = r / SPAN.
"""

import numpy as np

SPAN = 4.0e4  # A/m: relays with larger thresholds never switch on these benches
LINES = 2400
RADII = 180
KINDS = ("gauss", "mixture", "lobes", "heavy", "rough", "cells")


def _gauss(u, v, rng):
    width, coercive = rng.uniform(0.24, 0.34), rng.uniform(0.02, 0.045)
    return np.exp(-0.5 * (u / width) ** 2) / (1 + (v / coercive) ** 2)


def _mixture(u, v, rng):
    total = np.zeros_like(u)
    for _ in range(4):
        width, coercive, centre = rng.uniform(0.12, 0.35), rng.uniform(0.015, 0.06), rng.uniform(0, 0.25)
        total += (
            rng.uniform(0.3, 1)
            / width
            / coercive
            * (np.exp(-0.5 * ((u - centre) / width) ** 2) + np.exp(-0.5 * ((u + centre) / width) ** 2))
            * np.exp(-v / coercive)
        )
    return total


def _lobes(u, v, rng):
    """Two lobes whose coercivity leans with the mean field."""
    a, b = rng.uniform(0.1, 0.2), rng.uniform(0.3, 0.42)
    first = np.exp(-0.5 * (np.abs(u) - a) ** 2 / 0.13**2) * np.exp(-0.5 * ((v - 0.02 - 0.03 * u) / 0.03) ** 2)
    second = np.exp(-0.5 * (np.abs(u) - b) ** 2 / 0.1**2) * np.exp(-0.5 * ((v - 0.06) / 0.035) ** 2)
    return first + rng.uniform(0.3, 0.7) * second + 0.05 * np.exp(-0.5 * (u / 0.4) ** 2 - v / 0.05)


def _heavy(u, v, rng):
    """Student in the mean field, log-normal in the coercive field."""
    width, mode, spread = rng.uniform(0.18, 0.28), rng.uniform(0.02, 0.05), rng.uniform(0.5, 0.9)
    return (1 + (u / width) ** 2 / 4) ** -2.5 * np.exp(-0.5 * (np.log((v + 1e-5) / mode) / spread) ** 2) / (v + 0.002)


def _rough(u, v, rng):
    """Ripple that does not factorise, 25 to 60 per cent."""
    ripple = sum(rng.normal() * np.cos(rng.uniform(8, 40) * u + rng.uniform(-60, 60) * v + rng.uniform(0, 6.3)) for _ in range(16))
    depth = rng.uniform(0.25, 0.6)
    return (_mixture if rng.uniform() < 0.5 else _heavy)(u, v, rng) * np.clip(1 + depth * ripple / np.sqrt(8), 0.05, None)


def _cells(u, v, rng):
    """Uniform cells of another level in the thresholds, each with its own random mass."""
    level = int(rng.integers(31, 53))
    row, column = (np.floor((x + 1) / 2 * level).astype(int).clip(0, level - 1) for x in (u + v, u - v))
    return (
        _gauss(np.round(u * level) / level, np.round(v * level) / level, rng) * rng.lognormal(0, 0.35, (level, level))[row, column]
    )


SHAPES = dict(zip(KINDS, (_gauss, _mixture, _lobes, _heavy, _rough, _cells), strict=True))


class PlayDensity:
    """Tables of F_r and its slope: `kind` names the density, `saturation` is what M reaches, A/m."""

    def __init__(self, kind, saturation, rng, radii=RADII):
        edges = SPAN * (np.arange(radii + 1) / radii) ** 2
        self.radii = 0.5 * (edges[1:] + edges[:-1])
        s = np.linspace(-SPAN, SPAN, LINES + 1)
        self.step = s[1] - s[0]
        U, V = np.meshgrid(0.5 * (s[1:] + s[:-1]) / SPAN, self.radii / SPAN)
        w = SHAPES[kind](U, V, rng) * (np.abs(U) + V <= 1) * np.diff(edges)[:, None]
        w *= saturation / (w.sum() * self.step)
        self.slope = 2 * w.ravel()  # dF/dp
        F = np.concatenate([np.zeros((radii, 1)), np.cumsum(2 * w * self.step, axis=1)], axis=1)
        F -= 0.5 * F[:, -1:]
        self.value = F[:, :-1].ravel()
        self.rows = np.arange(radii) * LINES
        self.saturation = saturation

    def start(self, shape, state):
        """Plays of fresh relays, (*shape, radii): "demagnetized", "negative" or "positive" saturation."""
        sign = {"demagnetized": 0.0, "negative": -1.0, "positive": 1.0}[state]
        return np.zeros((*shape, len(self.radii))) + sign * (SPAN - self.radii)

    def evaluate(self, plays, field, extra=0.0):
        """New plays, M and dM/dH at `field`, (...); `extra` widens every play, A/m."""
        r = self.radii + np.asarray(extra)[..., None]
        new = np.clip(plays, field[..., None] - r, field[..., None] + r)
        place = (new + SPAN) / self.step
        k = np.clip(place, 0, LINES - 1).astype(np.intp)
        index = k + self.rows
        slope = self.slope[index]
        M = (self.value[index] + slope * self.step * (place - k)).sum(axis=-1)
        return new, M, (slope * (new != plays)).sum(axis=-1)
