"""Free strain from magnetization: the square law of (5) and what may stand in its place. Lengths in m."""

import numpy as np

M_S, LENGTH, LAMBDA_S = 7.87e5, 5.13e-2, 1.313e-3
FULL = LENGTH * LAMBDA_S  # m at saturation


def free_displacement(M, H, effects):
    """Displacement of the unloaded rod, m, from one settled period (recordings, steps) of M and H, A/m."""
    m = M / M_S
    square = m**2
    b = effects.get("quartic_magnetostriction", 0.0)
    if b:  # moments turning in a cubic crystal: a cosh in place of the square, of the same saturation
        gamma = np.sqrt(12 * abs(b))
        square = (np.cosh(gamma * m) - 1) / (np.cosh(gamma) - 1) if b > 0 else (1 - np.cos(gamma * m)) / (1 - np.cos(gamma))
    strain = square + effects.get("linear_strain", 0.0) * m
    if "strain_hysteresis" in effects:  # domain walls pinned once more: plays of the square, Prandtl and Ishlinskii
        widths = np.array([0.004, 0.01, 0.02, 0.04])
        pinned = np.mean([settled_play(square, w) for w in widths], axis=0)
        strain = strain + effects["strain_hysteresis"] * (pinned - square)
    if "field_kink" in effects:  # in no catalogue: a metamagnetic step of the strain at one field
        strain = strain + effects["field_kink"] * np.tanh((H - 1.5e4) / 400.0)
    return FULL * strain


def settled_play(x, width):
    """Play of half-width `width` driven twice through one period of `x` (recordings, steps)."""
    p = x[:, 0].copy()
    out = np.empty_like(x)
    for _turn in range(2):
        for n in range(x.shape[1]):
            p = np.clip(p, x[:, n] - width, x[:, n] + width)
            out[:, n] = p
    return out
