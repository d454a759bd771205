"""What a learned function looks like: its value and how far it is known, where it bends, and what that leaves open of a prediction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from magjax.effects.learned_term import OUTPUTS, UNITS, turning
from magjax.programs import kept
from magjax.simulate import run_chain

from .learned import Learned

BASE_LOSSES = {  # of the base, that act as a constant times a rate
    ("coil", "flux_rate"): ("coil.R_eddy", "coil.k_eddy", "effects.eddy_currents.k"),
    ("mechanics", "displacement_rate"): ("mechanics.xi",),
}
GRID = 121
BEYOND = 0.25  # of the range seen, shown on either side of it


def band(learned: Learned, *values):
    """The learned function and its standard deviation at some values of its variables, unit of the block's output.

    Centred on the range seen, for a constant is not told from the base; of a function times a rate whose loss is fitted
    (`_taken_up`) its mean at each rate. Beyond the range the deviation grows with the distance as the slope of the prior does.
    """
    term = learned.term
    values = [np.asarray(v, float) for v in values]
    waves, outside = (np.asarray(x) for x in term.basis(*values, xp=np))
    shape = waves.shape[1:]
    rows = waves.reshape(len(waves), -1)
    if _taken_up(learned):
        along = np.linspace(float(term.low[0]), float(term.high[0]), 41)[:, None]
        middle = term.basis(*np.broadcast_arrays(along, values[1].ravel()), xp=np)[0].mean(axis=1)
    else:
        axes = np.meshgrid(*(np.linspace(float(a), float(b), 41) for a, b in zip(term.low, term.high, strict=True)), indexing="ij")
        middle = term.basis(*axes, xp=np)[0].reshape(len(waves), -1).mean(axis=1)[:, None]
    rows = rows - middle
    size = float(term.size)
    value = size * (np.array([float(c) for c in term.coefficients]) @ rows)
    variance = (
        np.einsum("ki,kl,li->i", rows, learned.covariance, rows, optimize=True)
        + np.sum(outside.reshape(len(outside), -1) ** 2, axis=0) / learned.place.length**2
    )
    return value.reshape(shape), size * np.sqrt(np.maximum(variance, 0.0)).reshape(shape)


def _taken_up(learned: Learned) -> str | None:
    """The fitted constant that takes up the mean of a function times a rate: the eddy resistance, the damping."""
    term = learned.term
    rival = BASE_LOSSES.get((term.place, *term.variables[1:]), ()) if term.counts[1:] == (1,) else ()
    return next((name for name in rival if name in learned.result.problem.layout.names), None)


@kept
def _sensitivities(actuator, drive, dt, periods, corners):
    """Reading, its derivative in every coefficient and in every end's slope, (coefficients + ends, time)."""
    term = actuator.effect("learned_term")
    number = len(term.coefficients)

    def reading(x):
        changed = dataclasses.replace(term, coefficients=tuple(x[:number]), beyond=x[number:])
        return run_chain(actuator.with_effect(changed), drive, dt, periods, corners).reading

    at = jnp.concatenate([jnp.stack(term.coefficients), term.beyond])
    value, push = jax.linearize(reading, at)
    return value, jax.lax.map(push, jnp.eye(len(at)), batch_size=8)


def prediction_interval(learned: Learned, drive, dt: float, periods: int = 3, corners: int = 8):
    """One settled period of the reading on a periodic drive, and its standard deviation by what the term leaves open."""
    value, rows = (
        np.asarray(x) for x in _sensitivities(learned.result.actuator, jnp.asarray(drive), jnp.asarray(dt), periods, corners)
    )
    number = len(learned.term.coefficients)
    ends = np.sum(rows[number:] ** 2, axis=0) / learned.place.length**2
    return value, np.sqrt(np.einsum("ki,kl,li->i", rows[:number], learned.covariance, rows[:number], optimize=True) + ends)


def _levels(term) -> list:
    """Values of the second variable at which a function is shown, [None] where it has none."""
    if len(term.variables) == 1:
        return [None]
    shares = (0.0, 1.0) if turning(term.variables)[1] else (0.1, 0.5, 0.9)
    return [float(term.low[1] + s * (term.high[1] - term.low[1])) for s in shares]


def _along(first, level) -> list:
    return [first] if level is None else [first, np.full_like(first, level)]


def region(learned: Learned):
    """The stretch of the first variable where the function bends: (low, high, share of the range) of 80 % of its squared
    curvature. A constant and a slope are what the base can take up; where the function bends is what it cannot."""
    term = learned.term
    first = np.linspace(float(term.low[0]), float(term.high[0]), 201)
    bend = [np.gradient(np.gradient(band(learned, *_along(first, level))[0])) for level in _levels(term)]
    power = np.sum(np.square(bend), axis=0)
    power[:6] = power[-6:] = 0.0  # the ends are the least known
    total = np.concatenate([[0.0], np.cumsum(power) / max(power.sum(), 1e-300)])
    best = (0, 200)
    for i in range(201):
        j = int(np.searchsorted(total, total[i] + 0.8))
        if j <= 201 and j - i < best[1] - best[0]:
            best = (i, min(j, 200))
    return float(first[best[0]]), float(first[best[1]]), (best[1] - best[0]) / 200


def described(learned: Learned) -> dict:
    """What diagnosis.json says of it, beside the block: variables, function with its band, worth, rivals."""
    term = learned.term
    low, high = np.asarray(term.low), np.asarray(term.high)
    reach = BEYOND * (high[0] - low[0])
    x = np.linspace(low[0] - reach, high[0] + reach, GRID)
    slices = []
    for level in _levels(term):
        value, deviation = band(learned, *_along(x, level))
        slices.append(
            {
                "at": level,
                "value": value.tolist(),
                "low": (value - 1.96 * deviation).tolist(),
                "high": (value + 1.96 * deviation).tolist(),
            }
        )
    reading, terms = learned.result.recordings[0].unit, learned.result.bench.terms
    unit = reading if OUTPUTS[term.place] == "reading" else terms.unit_of(OUTPUTS[term.place])

    def named(place):
        names = [terms.word(v).replace(" ", "_") for v in place.variables]
        return [*names[:-1], f"times_{names[-1]}"] if place.term.counts[-1] == 1 else names

    units = [terms.unit_of(UNITS[v]).replace("reading", reading) for v in term.variables]
    axes = np.meshgrid(*(np.linspace(float(a), float(b), 41) for a, b in zip(low, high, strict=True)), indexing="ij")
    fits = {place.boundary: worth for place, *worth in learned.tried}
    return {
        "variables": named(learned.place), "variable_units": units, "unit": unit, "share": learned.share,
        "seen": [[float(a), float(b)] for a, b in zip(low, high, strict=True)], "rms": float(np.sqrt(np.mean(band(learned, *axes)[0] ** 2))),
        "mean_in": _taken_up(learned), "left_out": list(learned.left_out), "bends_over": learned.place.length,
        "turns_within": float(term.knee[-1]) if learned.place.turns else None,
        "function": {"x": x.tolist(), "slices": slices},
        "boundaries": [
            {
                "block": p.block, "variables": named(p), "evidence": p.evidence, "share": p.share, "visibility": p.visibility,
                **dict(zip(("chi2_per_sample", "left_out"), fits.get(p.boundary, (None, None)), strict=True)),
            }
            for p in learned.places
        ],
        "rivals": [{"block": p.block, "variables": named(p)} for p in learned.rivals],
    }  # fmt: skip
