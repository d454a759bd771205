"""The next experiment: what best tells rivals apart, within the bench's limits.

A drive separates two rivals by what is left of the difference of their predictions once either may still move as far as
its own fit leaves it free: d' (1 + J_a C_a J_a' + J_b C_b J_b')^-1 d in units of the noise, J the Jacobian of the new
reading's harmonics, C the covariance of the fit. A difference that a rival's density could take up separates nothing.
Rivals of which some stand in an instrument and some in the rod are settled by recording the instrument itself.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from magjax.errors import MagjaxError
from magjax.terms import DRIVE_UNITS

from .joint import data_jacobian, data_residual
from .model import Predictor
from .spectra import line_deviations
from .together import let_go, together
from .uncertainty import covariance

SURE = 0.9
PERIODS = 4
CENTRED = 1e-4  # of the range of the drives, an offset that is none
SHUNT = "the coil's current by a shunt beside its command"
CALIBRATION = "a calibration of the sensor (its reading of a known displacement; a mass added, which moves the rod's resonance alone, tells too)"
PICK_UP = "a calibration of the pick-up's channel (its reading of a known emf at the drive's frequencies)"
INSTRUMENTS = ("source", "sensor")
CHANNELS = {
    frozenset(("coil", "hysteresis")): "the flux density by a pick-up coil round the rod",
    frozenset(("magnetostriction", "sensor")): "a calibration of the sensor over its range",
}


def channels_for(blocks, output: str = "displacement") -> list[str]:
    """What to record, in words, for rivals (or a model) in these blocks: shunt and calibration where an instrument is among them."""
    blocks, known = set(blocks), CALIBRATION if output == "displacement" else PICK_UP
    if frozenset(blocks) in CHANNELS:
        return [CHANNELS[frozenset(blocks)]]
    wanted = []
    if len(blocks) > 1:
        wanted += [SHUNT] if "source" in blocks else []
        wanted += [known] if "sensor" in blocks else []
    elif blocks == {"sensor"}:
        wanted = [known]
    return wanted


def instrument_request(blocks, reason: str = "") -> dict:
    """The request of an instrument's own recording: a `next_experiment` without a drive."""
    wanted = channels_for({*blocks, "mechanics"})
    return {"text": f"record {' and '.join(wanted)}{reason}", "drive": None, "channels": wanted, "separates": []}


def next_experiment(trials, spectra, bench, also=()) -> dict | None:
    """A sine of the menu that separates the rivals best, and the channel that would settle it outright.

    `also`: blocks beside the rivals' own that are in question.
    """
    if len(trials) < 2:
        return None
    trials = trials[:3]
    wanted = channels_for({*(t.candidate.block for t in trials), *also}, bench.output)
    names = [t.name for t in trials]
    drives = menu(spectra, bench)
    apart = separations(trials, drives, spectra)
    best = None if apart is None else int(np.argmax(apart.min(axis=1)))
    found = {"text": "", "drive": None, "channels": wanted or [bench.output], "separates": []}
    parts = [f"record {' and '.join(wanted)}"] if wanted else []
    if best is not None:
        f, A, offset = drives[best]
        unit = DRIVE_UNITS[bench.drive]
        odds = np.minimum(ndtr(0.5 * apart[best]), 0.99)
        frequency = f"{f:.3g}" if f < 1000 else f"{f:.0f}"
        sine = f"a sine of {frequency} Hz, amplitude {A:.3g} {unit}, offset {offset:.3g} {unit}, four settled periods"
        if odds.min() >= SURE or not wanted:
            found["drive"] = {
                "kind": "sine",
                "frequency_Hz": float(f),
                "amplitude": float(A),
                "offset": float(offset),
                "periods": PERIODS,
            }
            found["separates"] = [[a, b, float(p)] for (a, b), p in zip(_pairs(names), odds, strict=True)]
            pairs = [f"{a} from {b} with probability {p:.2f}" for a, b, p in found["separates"]]
            parts.append(f"{sine}: separates {', '.join(pairs)}")
        else:
            worst = "" if len(odds) == 1 else " of the nearest two"
            parts.append(f"no sine within the limits does as well (the best: {sine}, with probability {odds.min():.2f}{worst})")
    found["text"] = "; ".join(parts) if len(parts) < 2 or found["drive"] is None else f"{parts[0]}; or {parts[1]}"
    return found


def _pairs(items):
    return [(a, b) for i, a in enumerate(items) for b in items[i + 1 :]]


def menu(spectra, bench) -> list[tuple[float, float, float]]:
    """(Hz, amplitude, offset) of sines within what has been visited and within the limits, slower and faster ones included."""
    phases = np.arange(200) / 200
    drives = [s.drive_at(phases) for s in spectra]
    low, high = min(d.min() for d in drives), max(d.max() for d in drives)
    limit = float(bench.limit or np.inf)
    low, high = max(low, -limit), min(high, limit)
    middle = 0.5 * (high + low)
    middle = middle if abs(middle) > CENTRED * (high - low) else 0.0  # of a drive about zero its converter's counts leave a rest
    seen = np.array([s.frequency for s in spectra])
    frequencies = {0.5 * seen.min(), np.sqrt(seen.min() * seen.max()), seen.max(), 1.5 * seen.max(), 2 * seen.max()}
    if bench.quasistatic:
        frequencies = {seen[0]}
    return [(f, share * 0.5 * (high - low), middle) for f in sorted(frequencies) for share in (0.98, 0.5)]


def separations(trials, drives, spectra):
    """Distance of every pair of rivals on every drive, standard deviations: (drives, pairs); None where one cannot be simulated."""
    let_go()
    try:
        known = together([lambda _, t=t: _predicted(t.result, drives, spectra) for t in trials])
    except MagjaxError:
        return None
    columns = []
    for (r_a, J_a, C_a), (r_b, J_b, C_b) in _pairs(known):
        rows = []
        for k in range(len(drives)):
            d = r_a[k] - r_b[k]
            spread = np.eye(len(d)) + J_a[k] @ C_a @ J_a[k].T + J_b[k] @ C_b @ J_b[k].T
            rows.append(float(np.sqrt(max(d @ np.linalg.solve(spread, d), 0.0))))
        columns.append(rows)
    return np.array(columns).T


def _predicted(result, drives, spectra):
    """Whitened harmonics of the drives, (drives, numbers), their Jacobian, (drives, numbers, unknowns), and the fit's covariance.

    By the programs of the fits, and so as many drives at once as there were recordings, the last repeated.
    """
    problem, solution, coarse = result.problem, result.refined, result.problem.predictors[0]
    like, memories = max(spectra, key=lambda s: len(s.reading)), problem.layout.memories
    wanted, z = [_asked(like, *drive) for drive in drives], np.array(solution.z)
    shared, most = len(z) - memories, memories or len(wanted)
    z[shared:] = 0.0
    wanted += wanted[-1:] * (-len(wanted) % most)
    rows = [_rows_of(problem, z, wanted[at : at + most], coarse) for at in range(0, len(wanted), most)]
    r, J = (np.concatenate(part)[: len(drives)] for part in zip(*rows, strict=True))
    return r, J[..., :shared], covariance(solution.normal, solution.z, problem.layout)[:shared, :shared]


def _rows_of(problem, z, spectra, coarse):
    """Of some drives: whitened harmonics, (drives, numbers), and their Jacobian."""
    samples = min(d.shape[1] for d in coarse.drives)
    predictor = Predictor.build(spectra, samples, coarse.harmonics, max(coarse.periods), max(coarse.corners, 4))
    deviations = np.stack([line_deviations(s, s.noise)[: coarse.harmonics + 1] for s in spectra])
    deviations[:, 0] = np.where(np.isinf(np.asarray(problem.target.deviations)[0, 0]), np.inf, deviations[:, 0])
    m, count = deviations.shape
    zero = jnp.zeros((m, count), complex)
    target = eqx.tree_at(
        lambda t: (t.lines, t.deviations, t.gain_rows, t.gain_shares),
        problem.target,
        (zero, jnp.asarray(deviations), zero, jnp.zeros((m, m))),
    )
    asked = dataclasses.replace(problem, predictors=(predictor, predictor), target=target, spectra=tuple(spectra))
    at = [np.concatenate([k * count + np.arange(count), m * count + k * (count - 1) + np.arange(count - 1)]) for k in range(m)]
    return data_residual(asked, z)[np.array(at)], data_jacobian(asked, z)[np.array(at)]


def _asked(spectrum, f, A, offset):
    """A spectrum as a recording of that sine would give it."""
    lines = np.zeros(len(spectrum.drive), complex)
    lines[:2] = offset, -0.5j * A
    return dataclasses.replace(spectrum, frequency=float(f), periods=PERIODS, drive=lines, hum=None, systematic=None)
