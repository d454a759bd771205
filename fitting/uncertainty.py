"""What a fit knows: standard errors, correlations, what is not identified, what sits at a bound, the outcome in words."""

import dataclasses

import numpy as np

WIDEN = 1.3  # stated errors are widened by this: the evidence weights take the roughness for granted
WIDEN_BESIDE = 2.6  # the same beside an effect: its law's form is taken for granted too
GAUGES = {  # free without a prior beside free masses, and why nothing holds them
    "coil.H_bias": "the density moved along the plane does the same: give it a prior",
    "coil.c0": "the density stretched along the plane does the same: give it a prior",
    "magnetostriction.lambda_s": "the scale of the masses, with R_eddy, does the same: give it a prior",
    "magnetostriction.M_s": "the scale of the masses, with R_eddy, does the same: give it a prior",
}
GAUGES |= dict.fromkeys(("piezo.stroke", "piezo.P_m", "piezo.V_m"), "the masses and chi, scaled, do the same: give it a prior")
NO_PRIOR = 1e-2  # in the optimiser's coordinate: what keeps a parameter finite
UNDERSMOOTH = 0.1  # parameters are quoted with a tenth of the roughness weights
RISE = 0.35  # of the cost, that a standard error must bring on the fine grid at least (a half is due), else it is led farther:
FARTHER = 3  # times, each twice as far
UNBIASED_BELOW = 1.3  # chi2/N below which what the floor of the density does to them is told


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One parameter: `value` and `stderr` in SI."""

    name: str
    value: float
    stderr: float
    unit: str
    meaning: str
    free: bool
    start: float
    at_bound: bool = False
    identified: bool = True
    why: str = ""  # it is not identified

    def __str__(self):
        if not self.free:
            return f"{self.name:32s} {self.value:12.6g}              {self.unit:10s} fixed"
        flags = (" AT BOUND" if self.at_bound else "") + ("" if self.identified else " NOT IDENTIFIED")
        return f"{self.name:32s} {self.value:12.6g} ± {self.stderr:<9.2g} {self.unit:10s} (start {self.start:.4g}){flags}"


def covariance(normal: np.ndarray, z: np.ndarray, layout, also=()) -> np.ndarray:
    """Inverse normal matrix on the unknowns that are not at a bound, and on those `also` (places); zero elsewhere."""
    inside = layout.inside(z)
    inside[list(also)] = True
    index = np.flatnonzero(inside)
    part = normal[np.ix_(index, index)]
    scale = 1 / np.sqrt(np.maximum(np.diag(part), 1e-300))
    inverse = np.linalg.inv(part * scale[:, None] * scale + 1e-11 * np.eye(len(index)))
    result = np.zeros_like(normal)
    result[np.ix_(index, index)] = inverse * scale[:, None] * scale
    return result


def floor_shift(problem, solution) -> np.ndarray:
    """How far each unknown, apart from the density's, moves in a Newton step that lets the density be negative.

    Where the density is next to nothing noise can only add to it, and the parameters make up for what it adds, by up to 1.5 of
    their errors. Without the floor the linear fit has no such bias, and errors that are larger, for it knows less.
    """
    layout, z = problem.layout, solution.z
    n = layout.density_unknowns
    shift = -covariance(solution.normal, z, layout, range(n)) @ solution.gradient
    lower, upper = layout.bounds
    shift[(z + shift <= lower) | (z + shift >= upper)] = 0.0
    shift[:n] = 0.0
    return shift


def widened(problem, solution, cov, index: int) -> float:
    """By how much the standard error of an unknown must be wider for the cost on the fine grid to rise by a half at its ends.

    The slope on the Jacobian's grid may promise more than a step of the size of an error changes on the fine one: on the measured loops of
    a rod three times as much, whatever the plane's cells. The others follow as their covariance `cov` says; 1 at least.
    """
    from .joint import data_residual, prior_matrix  # with JAX, which a report made anew does not need
    from .solver import cost_of

    layout, z = problem.layout, solution.z
    if not cov[index, index] > 0:
        return 1.0
    prior, along = prior_matrix(problem, solution.weights), cov[:, index] / np.sqrt(cov[index, index])

    def cost(z):
        z = np.clip(z, *layout.bounds)
        return cost_of(data_residual(problem, z), z, prior)

    here, rise, times = cost(z), 0.0, 1.0
    for times in 2.0 ** np.arange(FARTHER + 1):
        rise = np.nan_to_num(0.5 * (cost(z + times * along) + cost(z - times * along)) - here, nan=np.inf)
        if rise >= RISE:
            break
    return float(max(times * np.sqrt(0.5 / max(rise, RISE)), times / 2)) if times > 1 else 1.0


def estimates(problem, solution, actuator) -> list[Estimate]:
    """Every declared parameter of the fitted actuator with its error.

    At the noise halfway between the fits with and without the floor of the density, half of what is between them is counted among the
    errors, and these are `widened`.
    """
    layout, z = problem.layout, solution.z
    cov = covariance(solution.normal, z, layout)
    at_noise = solution.chi2 < UNBIASED_BELOW * problem.data_count
    half = 0.5 * floor_shift(problem, solution) if at_noise else np.zeros_like(z)
    widen = WIDEN_BESIDE if actuator.effects else WIDEN
    inside, rows = layout.inside(solution.z), []
    for name, (value, info) in actuator.parameters().items():
        value = float(np.asarray(value))
        if name in layout.names:
            index, value = layout.index(name), float(layout.value(name, z + half))
            slope = layout.slope(name, solution.z)
            own = (widened(problem, solution, cov, index) if at_noise else 1.0) * np.sqrt(max(cov[index, index], 0.0))
            stderr = widen * abs(slope) * float(np.hypot(own, half[index]))
            reach = max(abs(value), info.scale)
            at_bound = bool(value <= info.low + 1e-9 * reach or value >= info.high - 1e-9 * reach or not inside[index])
            start = float(layout.starts[layout.names.index(name)])
            k = layout.names.index(name)
            gauge, prior = name in GAUGES and layout.density_unknowns > 0, float(np.asarray(problem.target.priors)[k])
            alone = gauge and prior <= NO_PRIOR
            if gauge and not alone:  # the cells' edges hold it, not the data: known as well as its prior says
                stderr = max(stderr, abs(slope) / prior)
            why = GAUGES[name] if alone else "" if stderr < 0.5 * reach else "its error is as large as itself"
            rows.append(Estimate(name, value, stderr, info.unit, info.meaning, True, start, at_bound, not why, why))
        else:
            rows.append(Estimate(name, value, 0.0, info.unit, info.meaning, False, value))
    return rows


def correlations(problem, solution) -> dict:
    """Correlation of each pair of free physical parameters: "a~b" -> coefficient."""
    layout = problem.layout
    cov = covariance(solution.normal, solution.z, layout)
    names = layout.names
    at = [layout.index(name) for name in names]
    found = {}
    for i, a in enumerate(names):
        for j in range(i + 1, len(names)):
            spread = np.sqrt(cov[at[i], at[i]] * cov[at[j], at[j]])
            found[f"{a}~{names[j]}"] = float(cov[at[i], at[j]] / spread) if spread > 0 else 0.0
    return found


def visited_cells(actuator, spectra) -> np.ndarray:
    """Which cells of the plane some recording switches: alpha below its highest field and beta above its lowest."""
    levels = np.asarray(actuator.hysteresis.levels)
    seen = np.zeros((len(levels) - 1,) * 2, bool)
    phases = np.arange(400) / 400
    from magjax.param import in_numpy  # with JAX, which a report made anew does not need

    coil = in_numpy(actuator.coil)
    for s in spectra:
        applied = coil.applied_field(s.drive_at(phases))
        seen |= (levels[:-1, None] < applied.max()) & (levels[None, 1:] > applied.min())
    return np.tril(seen)
