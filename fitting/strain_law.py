"""Static strain curves (strain against magnetization at several stresses): which law of magnetostriction serves.

The square law of T&B (5), lambda = g m^2 with m = M / M_s, is the first terms of an even series (Jiles 1995, J. Phys. D 28:1537)
    lambda = sum over k of g_k(u) m^k,  k = 2, 4, 6,
whose coefficients may depend on another variable u. Between two families of domains that u favours they pass from one value
to another,
    g_k(u) = a_k + b_k tanh((u - u0) / w).
Laws and variables are judged on curves that took no part: each stress is left out in turn.
"""

import dataclasses
import itertools

import numpy as np
from scipy.optimize import minimize

from magjax.constants import MU0
from magjax.errors import ConfigurationError, RecordingError
from magjax.readers import read_columns

LAWS = {"square": (2,), "quartic": (2, 4), "sextic": (2, 4, 6)}
FOUND_WANTING = 0.8  # of the held-out error that a larger law must leave at most
VARIABLES = ("stress", "field", "flux_density")


@dataclasses.dataclass(frozen=True)
class Curves:
    """Strain curves as one table. `magnetization` A/m, `strain`, `variables`: name -> values, SI; `curve`: number of each row."""

    magnetization: np.ndarray
    strain: np.ndarray
    variables: dict
    curve: np.ndarray
    saturation: float


@dataclasses.dataclass(frozen=True)
class StrainLaw:
    """One law fitted. `powers` of m; `variable` that its coefficients follow, None where they are constant.

    `center`, `width`: of the passage, unit of the variable; `coefficients`: (powers, 1 or 2); `rms`: on all curves;
    `held_out`: on each curve left out in turn, both strain.
    """

    name: str
    powers: tuple[int, ...]
    variable: str | None
    center: float
    width: float
    coefficients: np.ndarray
    rms: float
    held_out: float

    def __call__(self, m, u=None):
        """Strain at relative magnetization m and, where the law follows one, the variable u (same shape)."""
        return _columns(m, u, self.powers, self.center, self.width) @ self.coefficients.ravel()


def load_curves(paths, bench) -> Curves:
    """The table of a bench whose output is "strain"; raises `RecordingError` where a column is missing or not a number."""
    found = []
    for path in paths:
        row = read_columns(path, bench, ("flux_density", "field", "magnetization", "strain", "stress"))
        if "magnetization" not in row:
            if not {"flux_density", "field"} <= set(row):
                raise RecordingError(
                    f"{path}: strain needs a magnetization, or flux density and field; map their columns in the bench file"
                )
            row["magnetization"] = row["flux_density"] / MU0 - row["field"]
        if not all(np.all(np.isfinite(v)) for v in row.values()):
            raise RecordingError(f"{path}: a column holds a value that is no number; mend or drop its row")
        found.append(row)
    common = set.intersection(*(set(r) for r in found))
    whole = {q: np.concatenate([r[q] for r in found]) for q in common}
    stress = whole.get("stress", np.concatenate([np.full(len(r["strain"]), float(k)) for k, r in enumerate(found)]))
    levels, curve = np.unique(stress, return_inverse=True)
    if len(levels) < 3:
        raise RecordingError(f"{len(levels)} curves; at least three (one a stress, or one a file) are needed to leave one out")
    variables = {q: whole[q] for q in VARIABLES if q in whole}
    saturation = bench.constants.get("magnetostriction.M_s", float(np.max(np.abs(whole["magnetization"]))))
    return Curves(whole["magnetization"], whole["strain"], variables, curve, saturation)


def _columns(m, u, powers, center, width):
    base = np.stack([m**k for k in powers], axis=-1)
    if u is None:
        return base
    return np.concatenate([base, base * np.tanh((u - center) / width)[..., None]], axis=-1)


def fit_law(curves: Curves, name: str, variable: str | None = None) -> StrainLaw:
    """One law by least squares over all curves, and its error on each curve left out in turn."""
    if name not in LAWS:
        raise ConfigurationError(f'law "{name}" is unknown; write one of {", ".join(LAWS)}')
    m, u, powers = curves.magnetization / curves.saturation, curves.variables.get(variable), LAWS[name]

    def solve(rows, start=None):
        def misfit(theta):
            A = _columns(m[rows], None if u is None else u[rows], powers, theta[0], np.exp(theta[1]))
            x = np.linalg.lstsq(A, curves.strain[rows], rcond=1e-10)[0]
            return float(np.mean((curves.strain[rows] - A @ x) ** 2)), x

        theta = np.zeros(2)
        if u is not None:
            span = np.ptp(u)
            if start is None:
                grid = itertools.product(np.quantile(u, np.linspace(0.05, 0.95, 12)), np.log(span * np.geomspace(0.03, 1.0, 8)))
                start = min(grid, key=lambda t: misfit(t)[0])
            scale = misfit(start)[0]
            steps = [start, np.add(start, (0.05 * span, 0)), np.add(start, (0, 0.3))]
            found = minimize(lambda t: misfit(t)[0] / scale, start, method="Nelder-Mead",
                             options={"initial_simplex": steps, "xatol": 1e-6 * span, "fatol": 1e-9, "maxiter": 400})  # fmt: skip
            theta = found.x
        error, x = misfit(theta)
        return theta, x, error

    everything = np.ones(len(m), bool)
    theta, x, error = solve(everything)
    left_out = np.zeros(len(m))
    for k in np.unique(curves.curve):
        rows = curves.curve != k
        t, c, _ = solve(rows, None if u is None else theta)
        A = _columns(m[~rows], None if u is None else u[~rows], powers, t[0], np.exp(t[1]))
        left_out[~rows] = curves.strain[~rows] - A @ c
    shape = (1 if u is None else 2, len(powers))
    return StrainLaw(name, powers, variable, float(theta[0]), float(np.exp(theta[1])), x.reshape(shape), float(np.sqrt(error)),
                     float(np.sqrt(np.mean(left_out**2))))  # fmt: skip


def diagnose_strain(curves: Curves) -> tuple[StrainLaw, dict]:
    """The law that serves, and every law tried: {(law, variable): StrainLaw}.

    From the square law on, the variable and the power that lower the held-out error most are added while each takes a
    fifth of it.
    """
    tried = {("square", None): fit_law(curves, "square")}
    best = tried["square", None]
    while True:
        laws = list(LAWS)
        larger = laws[min(laws.index(best.name) + 1, len(laws) - 1)]
        options = {(larger, best.variable)}
        if best.variable is None:
            options |= {(best.name, v) for v in curves.variables} | {(larger, v) for v in curves.variables}
        elif "sextic" != best.name:
            options.add(("sextic", best.variable))
        for option in options - set(tried):
            tried[option] = fit_law(curves, *option)
        ranked = sorted((tried[o] for o in options), key=lambda law: law.held_out)
        if ranked[0].held_out > FOUND_WANTING * best.held_out:
            return best, tried
        # the smallest law that is nearly as good
        close = [law for law in ranked if law.held_out < 1.1 * ranked[0].held_out]
        best = min(close, key=lambda law: law.coefficients.size)


def strain_verdict(curves: Curves) -> dict:
    """The content of diagnosis.json for strain curves, with "message" in plain words."""
    best, tried = diagnose_strain(curves)
    square = tried["square", None]
    spread = float(np.std(curves.strain))
    table = [
        {"law": law.name, "variable": law.variable, "rms": law.rms, "held_out_rms": law.held_out}
        for law in sorted(tried.values(), key=lambda law: law.held_out)
    ]
    content = {"verdict": "nothing_missing", "effects": [], "groups": [], "laws": table, "spread": spread}
    if best is square:
        content["message"] = f"the square law serves: {square.held_out:.3g} rms on curves left out, of {spread:.3g}."
        return content
    without = min((law.held_out for law in tried.values() if law.variable is None), default=square.held_out)
    parameters = {
        f"g{k}": {"value": float(v), "stderr": None, "unit": "1"} for k, v in zip(best.powers, best.coefficients[0], strict=True)
    }
    text = f"the square law is found wanting: {square.held_out:.3g} rms on curves left out, of {spread:.3g}. "
    if best.variable:
        unit = {"stress": "Pa", "field": "A/m", "flux_density": "T"}[best.variable]
        parameters |= {
            f"d{k}": {"value": float(v), "stderr": None, "unit": "1"}
            for k, v in zip(best.powers, best.coefficients[1], strict=True)
        }
        parameters |= {
            "center": {"value": best.center, "stderr": None, "unit": unit},
            "width": {"value": best.width, "stderr": None, "unit": unit},
        }
        rivals = [law.held_out for law in tried.values() if law.variable not in (None, best.variable)]
        text += (
            f"The variable is {best.variable}: coefficients that pass over at {best.center:.3g} {unit} within {best.width:.3g} {unit} leave "
            f"{best.held_out:.3g}" + (f" (best with another variable {min(rivals):.3g}" if rivals else " (")
            + f", without any {without:.3g}). "
        )  # fmt: skip
    text += f"The law that serves: {best.name}, terms {', '.join(f'm^{k}' for k in best.powers)}"
    text += f" that depend on {best.variable}." if best.variable else "."
    names = ["quartic_magnetostriction"] if len(best.powers) > 1 else []
    names += [f"{best.variable}_dependent_magnetostriction"] if best.variable else []
    content |= {
        "verdict": "attributed", "message": text,
        "effects": [{"name": n, "block": "magnetostriction", "parameters": parameters, "confidence": None, "shifts": {}} for n in names],
    }  # fmt: skip
    return content


def draw_strain(curves: Curves, law: StrainLaw, square: StrainLaw, path) -> None:
    """Measured curves, the law that serves and the square law, as a PNG."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    numbers = np.unique(curves.curve)
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(numbers)))
    for k, colour in zip(numbers, colours, strict=True):
        rows = curves.curve == k
        M = curves.magnetization[rows]
        u = None if law.variable is None else curves.variables[law.variable][rows]
        axis.plot(M / 1e3, 1e6 * curves.strain[rows], ".", ms=3, color=colour)
        axis.plot(M / 1e3, 1e6 * law(M / curves.saturation, u), "-", lw=1, color=colour)
    M = np.linspace(0, np.max(curves.magnetization), 200)
    axis.plot(
        M / 1e3,
        1e6 * square(M / curves.saturation),
        "k--",
        lw=1.2,
        label=f"square law, {square.held_out * 1e6:.2g} ppm on curves left out",
    )
    axis.plot(
        [],
        [],
        "-",
        color="0.4",
        label=f"{law.name}" + (f" with {law.variable}" if law.variable else "") + f", {law.held_out * 1e6:.2g} ppm",
    )
    axis.set(xlabel="magnetization (kA/m)", ylabel="strain (ppm)", title="Strain curves (dots) and the law that serves (lines)")
    axis.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)
