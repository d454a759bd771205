"""The learned term of an `unknown_at`: its joint fit with everything else, and at which boundary it serves best.

The places that lead in `nonparametric` are fitted for real, all unknowns at once, the coefficients held by their prior.
The one that foretells recordings left out one at a time best is kept, if it does so better than the model without it.
What the function looks like is told in `learned_function`, what a diagnosis makes of it in `learned_verdict`.
"""

import contextlib
import dataclasses
import functools

import jax.numpy as jnp
import numpy as np

from magjax.effects.learned_term import LearnedTerm

from .attribute import excess_of
from .finer import FINER_FROM, REFINE_BELOW, REFINE_BESIDE, finer_hats
from .fit import finish
from .joint import data_jacobian, data_residual, prior_matrix, solve
from .nonparametric import ONE, Place, locate_places
from .plain import COARSE
from .setup import build_problem
from .task import Late
from .together import let_go
from .uncertainty import WIDEN, covariance

TRIED = 4  # leaders that are fitted jointly
NEAR, NEAR_IF_SIMPLE = 0.9, 0.6  # share of the best evidence that makes another boundary worth a fit; a function of one variable there beside one of two
MET = 1.1  # chi2/N of a term beside which only places of nearly its evidence are tried
ALL_BUT = 0.01  # of the excess, that a simple function may leave where, from far off, no others are sought: a kink between cosines leaves some
CLOSE = 0.96
SIMPLER, SOME_WAY = 0.93, 0.4  # of the evidence is enough for one variable in place of two, or to be tried beside it
SMOOTH = 0.25  # of the range, over which a function bends that is fitted first far from the noise; and the share of the chi2 that it
BENDS_MORE = 0.9  # leaves, of which one that bends as the evidence asks must leave less
TRAVEL_STEPS, NEARER = (2.0, 1.3), 0.98  # by which the travel of a direction is changed, while so much of the chi2 is left
KEPT = 0.8  # of the excess when recordings are left out may remain, else the term is not kept,
HALF = 0.5  # nor where it takes less of the excess: what acts at a block is taken there, most of it
UNSEEN = 0.03  # of what a recording alone shows: left out, it is taken to miss no more than what is left of it by this
RESIZED = 1.6  # change of the term's prior size that asks for another solution


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
        """Whether it takes most of the excess and foretells recordings that took no part better."""
        before, after = self.left_out
        return self.share > HALF and after < 1 + KEPT * (before - 1)


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


def fit_term(base, place: Place, recordings, bench, progress=None, target: float = np.inf) -> Learned:
    """Fit a place's term jointly with density, parameters and adopted effects of a `FitResult`; `target`: a chi2 above which it is of
    no use, and foretells nothing.

    Far from the noise the evidence asks for a function that bends as the rest of the model is wrong: a smooth one is fitted first
    there, and one that bends as it asks from where that ended. Of a direction, the travel is sought, too.
    """
    say = progress or (lambda *a: None)
    choices = _fine_enough(base.choices, place)
    steps = functools.partial(say, f"learning {place.joined(str)} at the {place.block}")
    far = base.chi2_per_sample > REFINE_BELOW
    found = _fitted(base, place.bent_over(max(place.length, SMOOTH)) if far else place, bench, steps, target, choices)
    if place.turns:
        found = _within_travel(found, base, bench, steps, target, choices)
    if found.place.length > place.length and found.chi2 < target:
        finer = _fitted(base, found.place.bent_over(place.length), bench, steps, target, choices, found)
        found = finer if finer.chi2 < BENDS_MORE * found.chi2 else found
    return _outcome(found, base, recordings, bench, target, choices)


def _outcome(found: "_Fitted", base, recordings, bench, target, choices) -> Learned:
    """What a fitted term is worth beside the base."""
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


def _within_travel(found: _Fitted, base, bench, say, target, choices) -> _Fitted:
    """The same with directions that come round within the travel that leaves least: the evidence does not know it where the plain model
    has bent to them."""
    for factor in TRAVEL_STEPS:
        before = found
        for step in (factor, 1 / factor):
            if found is not before:
                break  # what lies the other way has been tried
            while (other := _fitted(base, found.place.turned_within(step), bench, say, target, choices, found)).chi2 < NEARER * found.chi2:
                found = other
    return found


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


def plain_places(places, tried) -> list[Place]:
    """Every function of one variable alone that is not among those `tried`."""
    had = {p.boundary for p in tried}
    return [p for p in places if len(p.variables) == 1 and p.boundary not in had]


def _nearly(t, base) -> bool:
    """Whether a simple function that is worth it leaves next to nothing of what a fit leaves."""
    return t.worth and t.place.simple and t.result.chi2_per_sample - 1 < ALL_BUT * (base.chi2_per_sample - 1)


def _needless(place, tried, base) -> bool:
    """Whether one of those tried meets the noise and is as simple and far ahead to first order, or is simple in the same block and
    comes near it."""
    near = [t for t in tried if t.place.simple and (t.result.chi2_per_sample < MET or _nearly(t, base))]
    same = any(t.place.block == place.block for t in near) and not place.simple
    met = [t for t in tried if t.result.chi2_per_sample < MET and t.place.simple >= place.simple]
    return same or any(place.evidence < CLOSE * t.place.evidence for t in met)


def learn(base, recordings, bench, progress=None, target: float = np.inf) -> Learned | None:
    """The term that serves best beside a fit, or None where none foretells left-out recordings better, or comes below the `target`.

    Far from the noise the evidence is no more than a hint, for the plain model has bent to what is missing: where none of its leaders
    serves, or from far off none meets the noise or is a simple one that comes near it, and there is no target, simple ones of the other
    blocks are tried, too, and then every function of one variable; and the density may be finer beside the term.
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
                if not _needless(place, tried, base):
                    let_go()
                    tried.append(fit_term(base, place, recordings, bench, progress, target))
        tried.sort(key=lambda t: np.nan_to_num(t.left_out[1], nan=np.inf))
        return any(t.worth for t in tried)

    served, far = try_all(chosen_places(places)), base.chi2_per_sample > REFINE_BELOW

    def to_go_on():
        near = any(t.result.chi2_per_sample < MET or _nearly(t, base) for t in tried)
        return target == np.inf and not (served and (near or not far))

    for others in (other_places, plain_places) if far else (other_places,):
        if to_go_on():
            served = try_all(others(places, [t.place for t in tried]))
    if not served:
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
    """Of terms that are worth it, those that foretell recordings left out about as well as the first of them, the best one first: the
    simplest, and of these the one that the rest of the model hides least, for another must be larger to be seen as much.
    """
    worth = [t for t in tried if t.worth]
    near = 1 + 1.3 * (worth[0].left_out[1] - 1) + 0.1
    return sorted((t for t in worth if t.left_out[1] < near), key=lambda t: (not t.place.simple, -t.place.visibility))


def _on_finer_hats(learned, base, recordings, bench, progress) -> Learned:
    """The same term beside finer and finer hats, as long as each takes half of what those before leave: the density was chosen
    without it. What it foretells of recordings left out is that of the first: finer cells are seen by one recording alone."""
    with contextlib.suppress(Late):
        while FINER_FROM[0] < learned.result.chi2_per_sample < REFINE_BESIDE and (choices := finer_hats(learned.result.choices)):
            finer = _from_there(learned, base, recordings, bench, progress, choices[0])
            if not excess_of(finer.result, 1.0) < COARSE * excess_of(learned.result, 1.0):
                break
            learned = dataclasses.replace(finer, left_out=learned.left_out)
    return learned


def _from_there(learned, base, recordings, bench, progress, choices) -> Learned:
    """The same term on another density, fitted from where it ended."""
    let_go()
    result, term, place = learned.result, learned.term, learned.place
    steps = functools.partial(progress or (lambda *a: None), f"learning {place.joined(str)} at the {place.block}, finer")
    values = np.array([float(c) for c in term.coefficients])
    before = _Fitted(place, result.problem, result.solution, result.actuator, term.size, values, learned.covariance)
    choices = _fine_enough(choices, place)
    return _outcome(_fitted(base, place, bench, steps, np.inf, choices, before), base, recordings, bench, np.inf, choices)


def _fine_enough(choices, place):
    """The choices with the samples that many cosines need."""
    return dataclasses.replace(choices, coarse=choices.fine) if max(place.term.counts) > ONE else choices
