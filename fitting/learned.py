"""The learned term of an `unknown_at`: its joint fit with everything else, what it is worth, how far it is known.

The places that lead in `nonparametric` are fitted for real, all unknowns at once, the coefficients held by their prior.
The one that foretells recordings left out one at a time best is kept, if it does so better than the model without it.
"""

import contextlib
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from magjax.effects.learned_term import OUTPUTS, UNITS, LearnedTerm
from magjax.programs import kept
from magjax.simulate import run_chain

from .attribute import AT_NOISE, MISFIT, excess_of
from .check import check_errors, foretold_text
from .diagnosis import misfit
from .finer import FINER_FROM, REFINE_BELOW, REFINE_BESIDE, finer_hats
from .fit import finish
from .joint import data_jacobian, data_residual, prior_matrix, solve
from .nonparametric import ONE, Place, locate_places
from .plain import COARSE
from .setup import build_problem
from .task import Late
from .together import let_go
from .uncertainty import WIDEN, covariance
from .verdict import WORSE, asked_for

TRIED = 4  # leaders that are fitted jointly
NEAR, NEAR_IF_SIMPLE = 0.9, 0.6  # share of the best evidence that makes another boundary worth a fit; a function of one variable there beside one of two
MET = 1.1  # chi2/N of a term beside which only places of nearly its evidence are tried
SMOOTH = 0.25  # of the range, over which a function bends that is fitted first far from the noise; and the share of the chi2 that it
BENDS_MORE = 0.9  # leaves, of which one that bends as the evidence asks must leave less
CLOSE = 0.96
SIMPLER, SOME_WAY = 0.93, 0.4  # of the evidence is enough for one variable in place of two, or to be tried beside it
WRONG_NAME = 0.25  # of what an effect leaves above the noise, that a learned function leaves where the effect is the wrong name
MANY = 3  # effects in place of which a function that leaves no more is the better word: so many at once are seldom missing
LEAVES_MISFIT = MISFIT  # chi2/N beside an effect that was named, from which a learned function is tried in its place;
NARROW = 0.35  # of the range, within which one at its own block bends where no form of its law does: a stop, a kink
AS_MUCH, FORETOLD = 1.1, 0.5  # of the chi2 of effects on finer hats, and of what they miss check recordings by, that one may leave
KEPT = 0.8  # of the excess when recordings are left out may remain, else the term is not kept; of that of check recordings, in place of a name at its own block
UNSEEN = 0.03  # of what a recording alone shows: left out, it is taken to miss no more than what is left of it by this
RESIZED = 1.6  # change of the term's prior size that asks for another solution
BASE_LOSSES = {  # of the base, that act as a constant times a rate
    ("coil", "flux_rate"): ("coil.R_eddy", "coil.k_eddy", "effects.eddy_currents.k"),
    ("mechanics", "displacement_rate"): ("mechanics.xi",),
}
GRID = 121
BEYOND = 0.25  # of the range seen, shown on either side of it


@dataclasses.dataclass(frozen=True)
class Learned:
    """A term fitted jointly. `left_out`: chi2 per datum of recordings left out, (before, after); `covariance`: of the
    coefficients; `share` of the excess misfit explained; `places`: all boundaries, by the evidence; `rivals`: boundaries
    whose joint fits do as well; `tried`: (place, chi2/N, chi2/N left out) of every joint fit."""

    place: Place
    term: LearnedTerm
    result: object
    covariance: np.ndarray = dataclasses.field(repr=False)
    left_out: tuple[float, float]
    share: float
    places: tuple = dataclasses.field(repr=False, default=())
    rivals: tuple = ()
    tried: tuple = dataclasses.field(repr=False, default=())

    @property
    def worth(self) -> bool:
        """Whether it foretells recordings that took no part better."""
        before, after = self.left_out
        return after < 1 + KEPT * (before - 1)


def left_out(problem, solution) -> np.ndarray:
    """chi2 per datum of each recording foretold from the others, by the linear model about the optimum.

    With H = J (J'J + P)^-1 J' the residual of the rows of a recording fitted without them is (I - H_kk)^-1 r_k; I - H_kk at least `UNSEEN`.
    """
    n = problem.layout.density_unknowns
    J, r = data_jacobian(problem, solution.z), data_residual(problem, solution.z)
    free = np.append(solution.z[:n] > 0, np.ones(len(solution.z) - n, bool))
    normal = J.T @ J + prior_matrix(problem, solution.weights)
    J, normal = J[:, free], normal[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * scale[:, None] * scale + 1e-11 * np.eye(len(scale))) * scale[:, None] * scale
    R, H = problem.target.lines.shape
    owner = np.concatenate([np.repeat(np.arange(R), H), np.repeat(np.arange(R), H - 1)])
    finite = np.isfinite(np.asarray(problem.target.deviations))
    rows = []
    for k in range(R):
        mine = owner == k
        hat = J[mine] @ inverse @ J[mine].T
        # a direction that only this recording shows is not foretold at all: what is left of it is next to nothing, and says no more
        shown, directions = np.linalg.eigh(hat)
        alone = directions.T @ r[mine] / (1 - np.minimum(shown, 1 - UNSEEN))
        rows.append(float(alone @ alone) / (2 * finite[k].sum() - finite[k, 0]))
    return np.asarray(rows)


def fit_term(base, place: Place, recordings, bench, progress=None, target: float = np.inf, choices=None) -> Learned:
    """Fit a place's term jointly with density, parameters and adopted effects of a `FitResult`; `target`: a chi2 above which it is of
    no use, and foretells nothing; `choices`: of another density than the fit's.

    Far from the noise the evidence asks for a function that bends as the rest of the model is wrong: a smooth one is fitted first
    there, and one that bends as it asks from where that ended.
    """
    say = progress or (lambda *a: None)
    choices = choices or base.choices
    choices = dataclasses.replace(choices, coarse=choices.fine) if max(place.term.counts) > ONE else choices
    steps = functools.partial(say, f"learning {place.joined(str)} at the {place.block}")
    far = base.chi2_per_sample > REFINE_BELOW
    found = _fitted(base, place.bent_over(max(place.length, SMOOTH)) if far else place, bench, steps, target, choices)
    if found.place.length > place.length and found.chi2 < target:
        finer = _fitted(base, place, bench, steps, target, choices, found)
        found = finer if finer.chi2 < BENDS_MORE * found.chi2 else found
    problem, solution = found.problem, found.solution
    missed = solution.chi2 > target
    result = finish(problem, solution, choices, bench, recordings, target=target)
    after = result.chi2_per_sample * result.data_count
    before = base.chi2_per_sample * base.data_count
    share = (before - after) / max(before - result.data_count, 1e-9)
    widened = found.spread * WIDEN**2 * max(result.chi2_per_sample, 1.0)
    others = (float(left_out(base.problem, base.solution).mean()), np.inf if missed else float(left_out(problem, solution).mean()))
    term = result.actuator.effect("learned_term")
    return Learned(found.place, term, result, widened, others, float(np.clip(share, 0.0, 1.0)))


@dataclasses.dataclass(frozen=True)
class _Fitted:
    """A model with the term of a `place`, fitted: its problem and solution; the model without the term, whose size and coefficients
    (`values`, with their covariance `spread`) came out as these."""

    place: Place
    problem: object
    solution: object
    actuator: object
    size: object
    values: np.ndarray
    spread: np.ndarray

    @property
    def chi2(self) -> float:
        return float(self.solution.chi2)


def _fitted(base, place, bench, say, target, choices, before: _Fitted | None = None) -> _Fitted:
    """The term of a place, fitted from where the base ended, or another fit of it `before`; once more where its size has come out as
    another."""
    of_base = base.problem.layout.names
    names = (*of_base, *(f"effects.learned_term.{c}" for c in place.term.parameters()))
    start, term, values = before or base, place.term, np.zeros(len(place.term.coefficients))
    if before is not None:
        term, values = dataclasses.replace(term, size=before.size), before.values
    actuator, problem, solution = start.actuator, start.problem, start.solution
    for again in range(2):
        n = problem.layout.density_unknowns
        density, levels = (problem.basis, solution.z[: n + 1]), solution.z[len(solution.z) - problem.layout.memories :]
        problem, z = build_problem(base.spectra, actuator.with_effect(term), bench, names, choices, density)
        z[len(z) - problem.layout.memories :] = levels
        index = problem.layout.index(names[len(of_base)]) + np.arange(len(values))
        z[index] = [problem.layout.coordinate(name, v) for name, v in zip(names[len(of_base) :], values, strict=True)]
        solution = solve(problem, z, solution.weights, max_jacobians=choices.max_jacobians, progress=say, target=target)
        if solution.interrupted:
            raise KeyboardInterrupt
        at = jnp.asarray(solution.z)
        found = {name: float(problem.layout.value(name, at)) for name in names}
        actuator, values = actuator.replace({name: found[name] for name in of_base}), np.array([found[name] for name in names[len(of_base) :]])
        slopes = np.asarray(problem.layout.scales)[index - problem.layout.density_unknowns - 1]
        spread = covariance(solution.normal, solution.z, problem.layout)[np.ix_(index, index)] * slopes[:, None] * slopes
        deviation = np.asarray(term.deviation)
        known = np.clip(1 - np.diag(spread) / deviation**2, 0.0, 1.0)  # of each coefficient, how much is the data's word
        factor = float(np.clip(np.sqrt(np.sum((values / deviation) ** 2) / max(known.sum(), 0.5)), 0.05, 20.0))
        if again or solution.chi2 > target or 1 / RESIZED < factor < RESIZED:
            break
        term, values = dataclasses.replace(term, size=term.size * factor), values / factor
    return _Fitted(place, problem, solution, actuator, term.size, values, spread)


def chosen_places(places) -> list[Place]:
    """Places worth a joint fit: of each block whose evidence comes near the first, a function of one variable where it
    serves nearly as well, else the best; in the first block two simple ones beside it where they come some way: one that is right
    foretells more, and its evidence is low where the rest of the model has bent to what is missing. Beside one of two variables those
    of one are worth it from farther off.
    """
    best = places[0].evidence
    farther = np.inf if any(p.simple and p.evidence > SIMPLER * best for p in places) else NEAR_IF_SIMPLE * best
    chosen = []
    for block in dict.fromkeys(p.block for p in places):
        mine = [p for p in places if p.block == block]
        serves = any(p.simple and p.evidence > SIMPLER * mine[0].evidence for p in mine)
        near = mine[0].evidence > NEAR * best
        first, nearly = mine[0] is places[0], SIMPLER * mine[0].evidence if near else np.inf
        least, most = (SOME_WAY * best, 2) if first and not serves else (min(nearly, farther), 1)
        chosen += [p for p in mine if p.simple and p.evidence > least][:most]
        chosen += [mine[0]] if near and not serves else []
    return chosen[:TRIED]


def other_places(places, tried) -> list[Place]:
    """Of each block without a simple place among those `tried`, its best one, where its evidence comes some way."""
    simple = [p for p in places if p.simple and p.evidence > SOME_WAY * places[0].evidence]
    had = {p.block for p in tried if p.simple}
    first = {p.block: p for p in reversed(simple)}  # the best of each comes last
    return sorted((p for block, p in first.items() if block not in had), key=lambda p: -p.evidence)[:TRIED]


def _needless(place, tried) -> bool:
    """Whether one of those tried meets the noise and is as simple and far ahead to first order, or is simple in the same block."""
    met = [t for t in tried if t.result.chi2_per_sample < MET and t.place.simple >= place.simple]
    same = any(t.place.simple and t.place.block == place.block for t in met) and not place.simple
    return same or any(place.evidence < CLOSE * t.place.evidence for t in met)


def learn(base, recordings, bench, progress=None, target: float = np.inf) -> Learned | None:
    """The term that serves best beside a fit, or None where none foretells left-out recordings better, or comes below the `target`.

    Far from the noise the evidence is no more than a hint: where none of its leaders serves and there is no target, simple ones of the
    other blocks are tried, too, and the density may be finer beside the term.
    """
    say = progress or (lambda *a: None)
    let_go()
    places = [p for p in locate_places(base, say) if p.evidence > 0]
    if not places:
        return None
    tried = []

    def try_all(chosen):
        with contextlib.suppress(Late):  # what was tried by then
            for place in chosen:
                if not _needless(place, tried):
                    let_go()
                    tried.append(fit_term(base, place, recordings, bench, progress, target))
        tried.sort(key=lambda t: np.nan_to_num(t.left_out[1], nan=np.inf))
        return any(t.worth for t in tried)

    if not try_all(chosen_places(places)) and not (target == np.inf and try_all(other_places(places, [t.place for t in tried]))):
        return None
    tried = [t for t in tried if np.isfinite(t.result.chi2_per_sample)]
    best, *others = _as_good(tried)
    rivals = tuple(t.place for t in others)
    fits = tuple(
        (t.place, float(t.result.chi2_per_sample), float(t.left_out[1]) if np.isfinite(t.left_out[1]) else None) for t in tried
    )
    best = best if target < np.inf else _on_finer_hats(best, base, recordings, bench, progress)
    return dataclasses.replace(best, places=tuple(places), rivals=rivals, tried=fits)


def _as_good(tried) -> list[Learned]:
    """Of terms fitted, those that foretell recordings left out about as well as the first of them, the best one first: the simplest, and
    of these the one that the rest of the model hides least, for another must be larger to be seen as much.
    """
    near = 1 + 1.3 * (tried[0].left_out[1] - 1) + 0.1
    return sorted((t for t in tried if t.worth and t.left_out[1] < near), key=lambda t: (not t.place.simple, -t.place.visibility))


def _on_finer_hats(learned, base, recordings, bench, progress) -> Learned:
    """The same term beside finer and finer hats, as long as each takes half of what those before leave: the density was chosen
    without it. What it foretells of recordings left out is that of the first: finer cells are seen by one recording alone."""
    with contextlib.suppress(Late):
        while FINER_FROM[0] < learned.result.chi2_per_sample < REFINE_BESIDE and (choices := finer_hats(learned.result.choices)):
            finer = fit_term(base, learned.place, recordings, bench, progress, choices=choices[0])
            if not excess_of(finer.result, 1.0) < COARSE * excess_of(learned.result, 1.0):
                break
            learned = dataclasses.replace(finer, left_out=learned.left_out)
    return learned


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


def region(learned: Learned):
    """The stretch of the first variable where the function bends: (low, high, share of the range) of 80 % of its squared
    curvature. A constant and a slope are what the base can take up; where the function bends is what it cannot."""
    term = learned.term
    first = np.linspace(float(term.low[0]), float(term.high[0]), 201)
    levels = (
        [[]] if len(term.variables) == 1 else [[float(term.low[1] + s * (term.high[1] - term.low[1]))] for s in (0.1, 0.5, 0.9)]
    )
    bend = [np.gradient(np.gradient(band(learned, first, *(np.full_like(first, v) for v in level))[0])) for level in levels]
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
    levels = [None] if len(low) == 1 else [float(low[1] + s * (high[1] - low[1])) for s in (0.1, 0.5, 0.9)]
    slices = []
    for level in levels:
        value, deviation = band(learned, *([x] if level is None else [x, np.full_like(x, level)]))
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
    fits = {_boundary(place): worth for place, *worth in learned.tried}
    return {
        "variables": named(learned.place), "variable_units": units, "unit": unit, "share": learned.share,
        "seen": [[float(a), float(b)] for a, b in zip(low, high, strict=True)], "rms": float(np.sqrt(np.mean(band(learned, *axes)[0] ** 2))),
        "mean_in": _taken_up(learned), "left_out": list(learned.left_out), "bends_over": learned.place.length,
        "function": {"x": x.tolist(), "slices": slices},
        "boundaries": [
            {
                "block": p.block, "variables": named(p), "evidence": p.evidence, "share": p.share, "visibility": p.visibility,
                **dict(zip(("chi2_per_sample", "left_out"), fits.get(_boundary(p), (None, None)), strict=True)),
            }
            for p in learned.places
        ],
        "rivals": [{"block": p.block, "variables": named(p)} for p in learned.rivals],
    }  # fmt: skip


def _boundary(place) -> tuple:
    """What a place is told by, however its function bends."""
    return place.block, place.variables, place.term.counts


def better_learned(base, named, blocks, recordings, bench, number: int = 1, check=(), progress=None) -> Learned | None:
    """A term that shows effects to be the wrong names: in another block than `blocks`, it leaves next to nothing of what they
    leave, or no more than `MANY` do, and foretells recordings left out better, and check recordings no worse; in place of one effect it
    must be as simple, and may be at its block where it bends in one `NARROW` place and check recordings say so. Of effects that leave a
    misfit on a density finer than the base's, it may leave as much, where it takes most of what they miss check recordings by. None elsewhere.

    `base`: the plain fit; `named`: that with the effects, their `number`.
    """
    most = AT_NOISE + (WRONG_NAME if number < MANY else 1.0) * max(named.chi2_per_sample - AT_NOISE, 0.0)  # chi2/N
    hats, chosen = base.choices.knots, named.choices.knots
    finer = named.chi2_per_sample > LEAVES_MISFIT and None not in (hats, chosen) and chosen > hats
    learned = learn(base, recordings, bench, progress, np.inf if finer else most * named.data_count)
    if learned is None or not (number > 1 or learned.place.simple):
        return None
    same = learned.place.block in blocks
    if same and (number > 1 or not region(learned)[2] < NARROW):
        return None
    rows = check_errors(named.actuator, learned.result.actuator, check, bench)
    before, after = misfit(rows, "rms_before"), misfit(rows, "rms_after")
    if after > WORSE[0] * before + WORSE[1] * len(rows):
        return None
    if same and not after < KEPT * before:
        return None
    left = learned.result.chi2_per_sample
    if left <= most and not learned.left_out[1] > left_out(named.problem, named.solution).mean():
        return learned
    return learned if finer and not same and left < AS_MUCH * named.chi2_per_sample and after < FORETOLD * before else None


def with_learned_term(found, base, recordings, bench, check=(), progress=None, learned=None):
    """An `unknown_at` with the term that models it, where one is worth it: block and region by it, the repaired model with
    it, check recordings before and after. `found`: a `Diagnosis`; `base`: the fit that it stands beside; `learned`: the term,
    where it is known."""
    learned = learned or learn(base, recordings, bench, progress)
    if learned is None:
        return dataclasses.replace(
            found, message=found.message + " No smooth function of the signals there foretells recordings left out any better."
        )
    rows = tuple(check_errors(found.base.actuator, learned.result.actuator, check, bench)) if check else ()
    gained = [r["rms_after"] / max(r["rms_before"], 1e-300) for r in rows]
    if gained and np.mean(np.square(gained)) > 1:
        return dataclasses.replace(
            found,
            message=found.message + " A smooth function learned from the recordings of the fit predicts the check recordings worse, so it is not kept.",
        )
    more = described(learned)
    start, end, part = region(learned)
    place, unit, words = learned.place, more["variable_units"][0], bench.terms.word
    where = (
        f"all over the range of the {words(place.variables[0])}"
        if part > 0.6
        else f"{words(place.variables[0])} {start:.3g} .. {end:.3g} {unit}"
    )
    unknown = {**(found.unknown or {}), "block": place.block, "region": where, **more}
    nearest = f"{learned.share:.0%} of the excess"
    text = (
        f"something is missing that no effect {asked_for(base.choices.only)} explains. It acts like a function of {place.joined(words)} "
        f"at the {place.block} ({where}): learned as one, it takes {nearest} (chi2/N {base.chi2_per_sample:.3g} -> {learned.result.chi2_per_sample:.3g}; "
        f"recordings left out {learned.left_out[0]:.3g} -> {learned.left_out[1]:.3g})."
    )
    if learned.rivals:
        rivals = [f"{p.block} ({p.joined(words)})" for p in learned.rivals]
        text += f" Not told from it: {'; '.join(rivals)}."
    text += foretold_text(rows)
    text += " Beyond the range seen its interval widens."
    return dataclasses.replace(found, message=text, unknown=unknown, check=rows or found.check, repaired=learned.result)
