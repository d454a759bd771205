"""Bounds of the inversion error, T&B Propositions 4.1 to 4.3, with their conditions as guards, and a simulated worst case."""

import dataclasses

import numpy as np

from ..errors import ConfigurationError
from .dynamic import PlainActuator


@dataclasses.dataclass(frozen=True)
class Bound:
    """`value`: bound of the error of M, A/m; `share`: of M_s; `g_bar`: the constant in (10), if any; `note`: a warning."""

    value: float
    share: float
    g_bar: float | None = None
    note: str = ""


def slope_limit(plant: PlainActuator) -> float:
    """C_g = C_nu, the largest dM/dH that any memory allows: twice the heaviest row or column over the cell width."""
    masses = _masses(plant)
    return float(2 * max(masses.sum(axis=1).max(), masses.sum(axis=0).max()) / plant.operator.step)


def _masses(plant):
    table = np.array(plant.operator._table)
    k = np.arange(plant.operator.cells)
    table[k, k + 1] = 0.0
    masses = np.tril(table[1:, :-1] - table[:-1, :-1] - table[1:, 1:] + table[:-1, 1:])
    masses[k, k] = plant.operator._diagonal
    return np.maximum(masses, 0.0)


def _warn(value, plant):
    return "the bound exceeds 2 M_s and says nothing: read the simulated worst case" if value > 2 * plant.operator.total else ""


def static_bound(plant: PlainActuator, delta_I=None, mass_errors=None, density_max=None, wanted=None) -> Bound:
    """Proposition 4.1: ||e_M|| <= delta_I M_s + 8 mu_max s0^2 / L.

    `delta_I`: relative error of the masses; or `mass_errors` (L, L), A/m, their standard errors from a fit, of which the
    sum takes the place of delta_I M_s (the second term of (8)). `density_max`: mu_max, A/m per (A/m)^2, the largest mass
    over a cell if None. `wanted`: the magnetizations to reach, A/m; they must lie in the range. With delta_I a mass that is
    zero in truth must be identified as zero. Raises `ConfigurationError` where a condition does not hold.
    """
    operator = plant.operator
    if wanted is not None:
        beyond = np.abs(np.asarray(wanted, float) - operator.offset) > operator.total
        if beyond.any():
            raise ConfigurationError(
                f"Prop. 4.1 needs targets within {operator.offset - operator.total:.5g} .. "
                f"{operator.offset + operator.total:.5g} A/m; "
                f"sample {int(np.argmax(beyond))} asks for {np.ravel(wanted)[np.argmax(beyond)]:.5g}"
            )
    masses = _masses(plant)
    if (delta_I is None) == (mass_errors is None):
        raise ConfigurationError("give either delta_I (a share) or mass_errors (standard errors of the masses, A/m)")
    if delta_I is not None:
        if not delta_I >= 0:
            raise ConfigurationError(f"delta_I = {delta_I}; give a share of zero or more")
        first = delta_I * operator.total
    else:
        errors = np.abs(np.asarray(mass_errors, float))
        if errors.shape != masses.shape:
            raise ConfigurationError(f"mass_errors must be {masses.shape}, as the masses, not {errors.shape}")
        first = float(errors.sum())
    area = operator.step**2
    weights = masses * (1 + np.eye(operator.cells))  # a diagonal cell is half as large
    largest = float(weights.max() / area) if density_max is None else float(density_max)
    s0 = 0.5 * (operator.high - operator.low)
    value = first + 8 * largest * s0**2 / operator.cells
    return Bound(value, value / operator.total, None, _warn(value, plant))


def forward_bound(plant: PlainActuator, h: float, g_bar=None) -> Bound:
    """Proposition 4.2, forward differences: needs h c1/c0 < 2, which T&B do not say; the optimal g_bar is C_g/(C_g + 2)."""
    C = slope_limit(plant)
    r = h * plant.c1 / plant.c0
    if not 0 < r < 2:
        raise ConfigurationError(
            f"h = {h:.4g} s breaks Prop. 4.2 (h c1/c0 = {r:.3g}, must be below 2); "
            f"the largest h that holds is {2 * plant.c0 / plant.c1:.4g} s"
        )
    g = C / (C + 2) if g_bar is None else _inside(g_bar, C)
    gamma = max(g, (C - g) / (1 + C)) / (1 - max(r - 1, 1 - r / (1 + C)))
    value = 2 * C * gamma * 0.5 * (plant.operator.high - plant.operator.low)
    return Bound(value, value / plant.operator.total, g, _warn(value, plant))


def backward_bound(plant: PlainActuator, h: float, g_bar=None) -> Bound:
    """Proposition 4.3, backward differences; holds for every h."""
    if not h > 0:
        raise ConfigurationError(f"h = {h}; give a positive sample time")
    C, r = slope_limit(plant), h * plant.c1 / plant.c0
    g = (1 + r) * C / (2 * (1 + r) + C) if g_bar is None else _inside(g_bar, C)
    gamma = max(g / (1 + r), (C - g) / (1 + C + r)) * (1 + C + r) / r
    value = 2 * C * gamma * 0.5 * (plant.operator.high - plant.operator.low)
    return Bound(value, value / plant.operator.total, g, _warn(value, plant))


def _inside(g_bar, C):
    if not 0 <= g_bar <= C:
        raise ConfigurationError(f"g_bar = {g_bar} must lie in [0, C_g] = [0, {C:.4g}]")
    return float(g_bar)


def decoupled_current(plant: PlainActuator, wanted, h: float, g_bar: float, forward: bool = False):
    """The current of (10): (fields H_bar of the wanted M, current). `forward` keeps H_bar[k-1] in the last term."""
    operator = plant.operator.copy()
    H = np.array([operator.solve(float(m)) for m in np.asarray(wanted, float)])
    before = np.concatenate([[H[0]], H[:-1]])
    last = before if forward else H
    return H, (1 + g_bar) / plant.c1 * (H - before) / h + (last - plant.H_bias) / plant.c0


def simulated_worst(
    plant: PlainActuator, h: float, g_bar: float, forward: bool = False, trials: int = 20, length: int = 200, seed: int = 0
) -> float:
    """Largest |e_M|, A/m, of scheme (10) over random wanted sequences, run through (9) by the same differences."""
    rng = np.random.default_rng(seed)
    low = plant.operator.offset - plant.operator.total
    top = plant.operator.offset + plant.operator.total
    worst = 0.0
    for _ in range(trials):
        jumps = rng.random() < 0.5
        wanted = (
            rng.uniform(low, top, length)
            if jumps
            else 0.5 * (low + top) + 0.49 * (top - low) * np.sin(np.cumsum(rng.uniform(0, 0.3, length)))
        )
        H, current = decoupled_current(plant, wanted, h, g_bar, forward)
        operator = plant.operator.copy()
        v = H[0]
        reached = [operator.apply(v)]
        gain = h * plant.c1
        for k in range(1, length):
            if forward:
                goal = plant.c0 * current[k - 1] + plant.H_bias
                step = gain / plant.c0 * (goal - v)
                probe = operator.copy()
                nudge = np.sign(step) * 1e-6 * (plant.operator.high - plant.operator.low)
                g = (probe.apply(v + nudge) - operator.magnetization) / nudge if nudge else 0.0
                v = v + step / (1 + max(g, 0.0))
                v = min(max(v, operator.low), operator.high)
                reached.append(operator.apply(v))
            else:
                v = operator.solve(v + operator.magnetization + gain * (current[k] + plant.H_bias / plant.c0), 1 + gain / plant.c0)
                reached.append(operator.magnetization)
        reached = np.array(reached)
        error = reached[1:] - wanted[:-1] if forward else reached - wanted
        worst = max(worst, float(np.abs(error).max()))
    return worst
