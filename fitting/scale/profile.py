"""Intervals of single parameters by profile likelihood: how far a parameter can move while all others make up for it.

The parameter is held, everything else is fitted again; the interval is where 2 (cost - least cost) stays below the
quantile of chi-squared with one degree of freedom. Right where the errors are not symmetric or a bound is near.
D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87-94.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2 as chi_squared

from magjax.errors import ConfigurationError
from magjax.scale import Chunk, Job, run_job

from ..joint import prior_matrix
from ..uncertainty import covariance
from .refit import lean, settle

HOLD = 1e4  # how much stiffer a held parameter is than the data hold it
SOLVES = 10  # for each end of an interval
CLOSE = 0.02  # of the root of the quantile
LOWER = 0.2  # of 2 cost, by which a profile may fall below the fit before it is said


@dataclasses.dataclass(frozen=True)
class End:
    """One end of an interval. `value`: SI; `found`: False where the profile stayed below the level or a bound came first.

    `points`: (value, 2 (cost - least cost)) on the way.
    """

    value: float
    found: bool
    note: str
    points: tuple[tuple[float, float], ...]


@dataclasses.dataclass(frozen=True)
class Profile:
    """Profile intervals. `ends`: name -> (low, high); `estimate`, `stderr`: what the fit quotes."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimate: np.ndarray
    stderr: np.ndarray
    ends: dict[str, tuple[End, End]]
    level: float
    outcome: object = dataclasses.field(repr=False, default=None)

    def interval(self, name: str) -> tuple[float, float]:
        """Low and high end, SI."""
        low, high = self.ends[name]
        return low.value, high.value

    def as_dict(self) -> dict:
        """The entry "profile" of fit.json."""
        rows = {}
        for k, name in enumerate(self.names):
            low, high = self.ends[name]
            rows[name] = {
                "low": low.value, "high": high.value, "low_found": low.found, "high_found": high.found,
                "estimate": float(self.estimate[k]), "stderr": float(self.stderr[k]), "unit": self.units[k],
                "points": sorted([*low.points, *high.points]),
            }  # fmt: skip
        return {"level": self.level, "parameters": rows}

    def __str__(self):
        lines = [f"  profile likelihood, {100 * self.level:g} % intervals"]
        for k, name in enumerate(self.names):
            low, high = self.ends[name]
            notes = "; ".join(e.note for e in (low, high) if e.note)
            lines.append(
                f"  {name:32s} {low.value:12.6g} .. {high.value:<12.6g} {self.units[k]:10s}" + (f" ({notes})" if notes else "")
            )
        return "\n".join(lines)


def full_names(short, names) -> tuple[str, ...]:
    """Parameters by full or by last name: "xi" -> "mechanics.xi". Raises `ConfigurationError` for one that is not free."""
    found = []
    for word in short:
        fitting = [n for n in names if word in (n, n.split(".")[-1])]
        if len(fitting) != 1:
            words = "is not free in this fit" if not fitting else f"may be {' or '.join(fitting)}"
            raise ConfigurationError(f'profile: "{word}" {words}; free are {", ".join(names)}')
        found += fitting
    return tuple(dict.fromkeys(found))


def profile_intervals(result, names=None, *, level: float = 0.95, executor=None, checkpoint=None, progress=None) -> Profile:
    """Profile intervals of a `FitResult`.

    `names`: full or last names (all free ones if None); `executor`, `checkpoint`, `progress` as in
    `magjax.scale.run_job`; each end of an interval is a chunk. Raises `ConfigurationError` for a name that is not free.
    """
    layout = result.problem.layout
    if not layout.names or not 0.5 <= level < 1:
        raise ConfigurationError(
            f"profile at level {level} of {len(layout.names)} free parameters: give a level of 0.5 to 1 and free a parameter"
        )
    names = layout.names if names is None else full_names(names, layout.names)
    problem, weights = lean(result.problem), result.refined.weights
    centre = settle(problem, result.refined.z, weights)
    normal = centre.jacobian.T @ centre.jacobian + prior_matrix(problem, weights)
    spread = covariance(normal, centre.z, layout, [layout.index(n) for n in names])
    known = result.actuator.parameters()
    bounds = {n: (known[n][1].low, known[n][1].high) for n in names}
    inputs = {
        "problem": problem, "z": centre.z, "weights": weights, "jacobian": centre.jacobian, "cost": centre.cost, "bounds": bounds,
        "deviations": {n: float(np.sqrt(spread[layout.index(n), layout.index(n)])) for n in names}, "level": level,
    }  # fmt: skip
    chunks = tuple(Chunk(f"{n} {side:+d}", (n, side)) for n in names for side in (-1, 1))
    outcome = run_job(Job("profile", walk, inputs, chunks), executor, checkpoint=checkpoint, progress=progress)
    ends = [End(r["value"], r["found"], r["note"], tuple(map(tuple, r["points"]))) for r in outcome.results]
    rows = [result.estimate(n) for n in names]
    return Profile(
        names, tuple(r.unit for r in rows), np.asarray([r.value for r in rows]), np.asarray([r.stderr for r in rows]),
        {n: (ends[2 * k], ends[2 * k + 1]) for k, n in enumerate(names)}, level, outcome,
    )  # fmt: skip


def held(problem, name: str, coordinate: float, stiffness: float):
    """The problem with a parameter held at an optimiser's coordinate: its start moved there, its prior made stiff.

    Shapes stay, so the compiled programs serve.
    """
    layout, k = problem.layout, problem.layout.names.index(name)
    start = layout.starts[k]
    moved = start * np.exp(coordinate) if layout.log[k] else start + layout.scales[k] * coordinate
    changed = eqx.tree_at(lambda a: a.starts, layout, layout.starts.at[k].set(moved))
    target = eqx.tree_at(lambda t: t.priors, problem.target, problem.target.priors.at[k].set(stiffness))
    return dataclasses.replace(problem, layout=changed, target=target)


def walk(inputs, item, rng):
    """One end of one interval: the root of sqrt(2 (cost - least cost)) = sqrt(quantile), nearly linear, by secants."""
    (name, side), problem = item, inputs["problem"]
    layout, weights = problem.layout, inputs["weights"]
    index, deviation = layout.index(name), inputs["deviations"][name]
    prior = prior_matrix(problem, weights)
    root = float(np.sqrt(chi_squared.ppf(inputs["level"], 1)))
    centre, z, jacobian = inputs["z"][index], inputs["z"], inputs["jacobian"]
    farthest = abs(_coordinate_of_bound(layout, name, inputs["bounds"][name], side) - centre)
    points, below, above = [], (0.0, 0.0), None
    distance, note = min(root * deviation, farthest), ""
    for _ in range(SOLVES):
        pinned = held(problem, name, centre + side * distance, HOLD / deviation)
        begin = np.array(z)
        begin[index] = 0.0
        found = settle(pinned, begin, weights, jacobian=jacobian, jacobians=5)
        z, jacobian = np.array(found.z), found.jacobian
        z[index] += centre + side * distance
        rise = found.chi2 + z @ prior @ z - 2 * inputs["cost"]
        height = float(np.sqrt(max(rise, 0.0)))
        points.append((float(layout.value(name, jnp.asarray(z))), float(rise)))
        if not found.converged:
            note = "a refit did not settle"
        elif rise < -LOWER:
            note = "lower cost than at the fit: the fit has not settled, or the misfit is large"
        if abs(height / root - 1) < CLOSE:
            return _end(points[-1][0], True, note, points)
        if height < root:
            below = (distance, height)
            if distance >= farthest:
                return _end(points[-1][0], False, "the bound comes first", points)
        else:
            above = (distance, height)
        distance = min(_next_distance(below, above, root), farthest)
    if above is None:
        return _end(float(side * np.inf), False, "flat: the profile stays below the level", points)
    share = (root - below[1]) / (above[1] - below[1])
    z[index] = centre + side * (below[0] + share * (above[0] - below[0]))
    return _end(float(layout.value(name, jnp.asarray(z))), True, note or "between two solves", points)


def _end(value, found, note, points):
    return {"value": value, "found": found, "note": note, "points": points}


def _next_distance(below, above, root):
    """Where the height should be the root: between two points by the secant, beyond the last by its slope."""
    if above is not None:
        share = (root - below[1]) / (above[1] - below[1])
        return below[0] + float(np.clip(share, 0.1, 0.9)) * (above[0] - below[0])
    return below[0] * float(np.clip(root / max(below[1], 1e-9), 1.02, 3.0))


def _coordinate_of_bound(layout, name, bounds, side):
    """The optimiser's coordinate of the bound on that side, the parameter's own or the fit's, infinite where there is none."""
    bound, kept = (b[side > 0] for b in (bounds, layout.bounds))
    kept = side * float(kept[layout.index(name)])
    if np.isfinite(bound) and not (layout.log[layout.names.index(name)] and bound <= 0):
        kept = min(kept, side * layout.coordinate(name, bound))
    return side * kept
