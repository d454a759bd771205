"""Density families to start from or to invent a bench with: masses on the cells, A/m, NumPy.

Each density mu(beta, alpha) is written in the mean field s = (alpha + beta)/2 and the coercive field r = (alpha - beta)/2;
`density_masses` integrates it over the cells by a midpoint rule on `refine` x `refine` points and scales the sum.
"""

import numpy as np

from ..errors import ConfigurationError


def density_masses(density, cells: int, low: float, high: float, total: float, refine: int = 6) -> np.ndarray:
    """Masses of a density mu(s, r) on an L x L plane, scaled so that their sum is `total`.

    `density`: vectorised function of mean field and coercive field, A/m. Cells on the diagonal count their triangle.
    """
    edges = low + (high - low) * (np.arange(cells * refine) + 0.5) / (cells * refine)
    alpha, beta = edges[:, None], edges[None, :]
    values = np.where(alpha >= beta, density(0.5 * (alpha + beta), 0.5 * (alpha - beta)), 0.0)
    values[np.diag_indices(len(edges))] *= 0.5
    masses = values.reshape(cells, refine, cells, refine).sum(axis=(1, 3))
    if not masses.sum() > 0 or masses.min() < 0:
        raise ConfigurationError("the density must be nonnegative and not zero on the whole plane")
    return masses * (total / masses.sum())


def gaussian_lorentzian_masses(cells, low, high, total, centre, width, coercive, coercive_width) -> np.ndarray:
    """Gaussian in the mean field (centre, width), Lorentzian in the coercive field, all A/m."""

    def density(s, r):
        return np.exp(-0.5 * ((s - centre) / width) ** 2) / (1 + ((r - coercive) / coercive_width) ** 2)

    return density_masses(density, cells, low, high, total)


def factorised_masses(cells, low, high, total, profile) -> np.ndarray:
    """mu = f(alpha) f(-beta), the factorised form; `profile` f is a function of field, A/m."""
    return density_masses(lambda s, r: profile(s + r) * profile(r - s), cells, low, high, total)


def uniform_masses(cells, low, high, total) -> np.ndarray:
    """The same density everywhere in the plane."""
    return density_masses(lambda s, r: np.ones_like(s), cells, low, high, total)


def forc_masses(curves: np.ndarray) -> np.ndarray:
    """Masses from first-order reversal curves at the levels.

    `curves`: (L+1, L+1), M on the curve that turned down at level i (row) when the field has fallen to level j <= i,
    A/m. The Everett function is half the drop, (M_i - M_ij)/2 (Mayergoyz), and the masses are its mixed differences.
    Negative masses, which noise makes, are set to zero.
    """
    curves = np.asarray(curves, float)
    everett = 0.5 * (np.diagonal(curves)[:, None] - curves)
    everett = np.tril(everett)
    masses = everett[1:, :-1] - everett[1:, 1:] - everett[:-1, :-1] + everett[:-1, 1:]
    return np.maximum(np.tril(masses), 0.0)
