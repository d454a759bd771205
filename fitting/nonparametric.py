"""What no named effect explains: in which block it acts, as a function of what, and that function itself.

For every block boundary and every one or two local variables there, the columns of a smooth function's coefficients
(cosines under the prior of a Gaussian process) are projected off the tangent space of the fit. The evidence of the linear
model says which boundary and variables serve, how smooth the function is and how large; the leaders are fitted
jointly with everything else, and the term is kept only where recordings left out one at a time are foretold better.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from magjax.chain import Timeline
from magjax.constants import MU0
from magjax.effects.learned_term import DIRECTION, PAD, LearnedTerm, direction_of, is_reversible, turning
from magjax.programs import kept
from magjax.simulate import driven_current, finish_chain, march_chain

from .adjoint import SIGNALS, as_lines
from .screen import Projector

ONE = 48  # cosines of a function of one variable
FINE = 160  # where none of these serves: of one variable of the sensor or the strain
TWO = (10, 7)
IN_STEP = (10, 6)  # inside the step every cosine costs in every iteration
ADDED_TO = {"magnetostriction": "free displacement", "mechanics": "displacement", "sensor": "reading"}  # which of `SIGNALS`, at a place
LENGTHS = (0.5, 0.25, 0.12, 0.06, 0.03, 0.015, 0.008)  # of the range, over which a function bends
FINER_GAIN = 5.0  # of evidence, that more cosines must bring
KNEE = 0.1  # of the largest rate, below which a rate counts linearly
TRAVELS = (0.03, 0.01, 0.1)  # of the range of a signal, within which its direction comes round

SETS = (
    ("source", ("current",)), ("source", ("current_rate",)), ("source", ("current", "current_rate")),
    ("coil", ("flux_rate",)), ("coil", ("flux_rate", "magnetization")), ("coil", ("flux_rate", "field")),
    ("hysteresis", ("field",)), ("hysteresis", ("magnetization",)), ("hysteresis", ("field_rate",)), ("hysteresis", ("field", "magnetization")),
    ("hysteresis", ("field_rate", "magnetization")),
    ("magnetostriction", ("magnetization",)), ("magnetostriction", ("field",)), ("magnetostriction", ("magnetization", "field")),
    ("magnetostriction", ("magnetization", "magnetization_rate")),
    ("mechanics", ("displacement",)), ("mechanics", ("displacement_rate",)), ("mechanics", ("displacement", "displacement_rate")),
    ("mechanics", ("stretch", "magnetization")),
    ("sensor", ("reading",)), ("sensor", ("reading_rate",)), ("sensor", ("reading", "reading_rate")), ("sensor", ("current_rate",)),
    ("sensor", ("current", "current_rate")), ("sensor", ("magnetization",)), ("sensor", ("flux_rate",)),
)  # fmt: skip
FACTORS = (  # a function of the first, times the second: a loss, an inductance, a coil, a damping, a friction, a gain that varies
    ("source", ("current", "current_rate")), ("coil", ("magnetization", "flux_rate")), ("coil", ("field", "flux_rate")),
    ("coil", ("magnetization", "current")), ("hysteresis", ("magnetization", "field_rate")),
    ("magnetostriction", ("magnetization", "magnetization_direction")), ("mechanics", ("displacement", "displacement_rate")),
    ("mechanics", ("magnetization", "displacement_rate")), ("mechanics", ("displacement", "displacement_direction")),
    ("sensor", ("reading", "reading_rate")), ("sensor", ("reading", "reading_direction")), ("sensor", ("current", "reading")),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Place:
    """How well a function of some variables at a block's output serves, to first order: `evidence` over none, `share` of
    the misfit explained, `length` of the range over which it bends, `size` (unit of the output), `term` at null."""

    block: str
    variables: tuple
    evidence: float
    share: float
    length: float
    size: float
    visibility: float
    term: LearnedTerm = dataclasses.field(repr=False)

    @property
    def simple(self) -> bool:
        """Whether it is a function of one variable, times another at most."""
        return len(self.variables) == 1 or self.term.counts[-1] == 1

    @property
    def boundary(self) -> tuple:
        """What it is told by, however its function bends."""
        return self.block, self.variables, self.term.counts

    def bent_over(self, length: float) -> "Place":
        """The same place with a function that bends over another length."""
        return self if length == self.length else dataclasses.replace(self, length=length, term=_with_prior(self.term, length))

    @property
    def turns(self) -> bool:
        """Whether the direction of a signal is among its variables."""
        return any(turning(self.variables))

    def turned_within(self, factor: float) -> "Place":
        """The same place with directions that come round within so many times the travel."""
        knee = np.where(turning(self.variables), factor, 1.0) * np.asarray(self.term.knee)
        return dataclasses.replace(self, term=dataclasses.replace(self.term, knee=jnp.asarray(knee)))

    def joined(self, word) -> str:
        """The variables by `word(name)`: "a and b", or "a, times b" where b is a factor."""
        names = [word(v) for v in self.variables]
        return ", times ".join(names) if self.term.counts[-1] == 1 else " and ".join(names)


@kept
def _signals(predictor, actuator):
    """Every signal of the last period of every recording with its rates, grid by grid."""

    def one(periods, drive, dt):
        line = Timeline(dt, drive.shape[0], True)
        current = driven_current(actuator, drive, line)
        marched = march_chain(actuator, line, current, periods, predictor.corners)
        s = finish_chain(actuator, line, drive, current, *marched)
        found = {
            "current": s.current,
            "field": s.relay_field,
            "coil_field": s.field,
            "magnetization": s.magnetization if actuator.piezo is None else s.magnetization - actuator.piezo.chi * s.field,
            "spread": marched[2],
            "reading": s.reading,
        }
        if s.displacement is not None:
            found |= {"displacement": s.displacement, "stretch": s.displacement - s.free_displacement}
        rates = {
            f"{n}_rate": line.derivative(found[n])
            for n in ("current", "field", "magnetization", "displacement", "reading")
            if n in found
        }
        return {**found, **rates, "flux_rate": line.derivative(s.flux_density)}

    return [jax.vmap(functools.partial(one, n))(d, t) for d, t, n in zip(predictor.drives, predictor.steps, predictor.periods, strict=True)]


@kept
def _directions(signal, travel):
    """Of a periodic signal of every recording, (recordings, samples)."""
    return jax.vmap(lambda x: direction_of(x, travel, Timeline(1.0, x.shape[0], True)))(signal)


def _step_signals(scheme, field, magnetization, current, dt):
    """What an effect inside the step sees, over the whole march of every recording, (recordings, time)."""
    X = field + magnetization
    back = np.concatenate([X[:, :1], X[:, :1], X], axis=1)
    change = 1.5 * X - 2 * back[:, 1:-1] + 0.5 * back[:, :-2] if scheme == "bdf2" else X - back[:, 1:-1]
    pace = dt[:, None]
    moved = np.diff(field, axis=1, prepend=field[:, :1])
    return {"field": field, "magnetization": magnetization, "current": current, "flux_rate": MU0 * change / pace, "field_rate": moved / pace}


def prior_deviations(counts, length: float) -> np.ndarray:
    """Standard deviation of each product of cosines: the spectrum of exp(-d^2 / (2 length^2)), of mean variance 1."""
    whole = np.ones(1)
    for count in counts:
        k = np.arange(count)
        power = np.exp(-0.5 * (k * np.pi * length / (1 + 2 * PAD)) ** 2)
        power /= power[0] + 0.5 * power[1:].sum()
        whole = (whole[:, None] * power[None]).ravel()
    return np.sqrt(np.maximum(whole, 1e-16))


def null_term(block, variables, signals, actuator, counts, travel: float = TRAVELS[0]) -> LearnedTerm:
    """A term at null over the range of the signals, in the natural unit of its block; `travel`: of a direction among the variables, of
    its signal's range."""
    ends, knees = zip(*(_range_of(v, signals, travel) for v in variables), strict=True)
    inside = np.ptp(signals["magnetization" if is_reversible(block, variables) else "field"])
    natural = {"source": np.ptp(signals["current"]), "coil": inside, "hysteresis": inside}
    reach = np.ptp(signals["reading"]) if actuator.strained is None else float(actuator.strained.reach)
    size = 1e-3 * natural.get(block, reach)
    low, high = np.transpose(ends)
    return LearnedTerm.null(block, variables, low, high, counts, np.ones(int(np.prod(counts))), size, np.array(knees))


def _range_of(variable, signals, travel):
    """(lowest, highest) and the knee of a variable."""
    x = signals[variable.removesuffix(DIRECTION)]
    if any(turning((variable,))):
        return (-1.0, 1.0), travel * np.ptp(x)
    return (x.min(), x.max()), KNEE * np.abs(x).max() if variable.endswith("_rate") else 0.0


@kept
def _moved(predictor, actuator, force):
    """Displacement by a force behind the hysteresis, given as the static displacement, m, (columns, recordings, samples)."""

    def one(force, dt):
        return Timeline(dt, force.shape[0], True).filter(force, actuator.mechanics.response)

    return jax.vmap(jax.vmap(one), (0, None))(force, predictor.steps[0])


class Tangents:
    """Columns of learned terms about a fit, and what is left of them off its tangent space."""

    def __init__(self, result):
        self.problem, self.solution = result.problem, result.refined
        self.actuator = self.problem.layout.actuator(self.problem.template, np.asarray(self.solution.z))
        self.predictor = self.problem.predictors[0]
        self.projector = Projector(self.problem, self.solution)
        self.fine = self.problem.predictors[1]  # a sharp function needs its samples
        passes, z = self.problem.passes, self.solution.z
        self.rows, self.marched = [], []
        for part, places, rows in passes.rows(z):
            self.marched.append(_step_signals(self.actuator.coil.scheme, *rows.path(), np.asarray(part.steps[0])[: len(places)]))
            self.rows.append(rows)
        self.parts = list(self.fine.batches())
        self.read = []
        self.last = []
        for part, places in self.parts:
            (signals,) = _signals(part, self.actuator)
            read = passes.read_rows(z, part, (signals["coil_field"], signals["magnetization"], signals["spread"]))[0]
            self.read.append(np.asarray(read)[: len(places)])
            self.last.append({n: np.asarray(x)[: len(places)] for n, x in signals.items()})
        self.signals = {n: np.concatenate([g[n].ravel() for g in self.last]) for n in self.last[0]}

    def columns(self, term) -> np.ndarray:
        """d (whitened misfit) / d coefficients, (data, coefficients)."""
        if term.in_step:
            at = 2 if term.place == "coil" else int(term.reversible)
            lines = [
                rows.of_steps(*(float(term.size) * self._waves(term, own) if k == at else None for k in range(3)))
                for rows, own in zip(self.rows, self.marched, strict=True)
            ]
        else:
            waves = [float(term.size) * self._waves(term, own) for own in self.last]
            if term.place == "source":
                coarse = [rows.signals.shape[3] for rows in self.rows]
                lines = [rows.of_drive(w[:, :, :: w.shape[2] // n]) for rows, w, n in zip(self.rows, waves, coarse, strict=True)]
            else:
                at = SIGNALS.index(ADDED_TO[term.place])
                if term.place == "mechanics":
                    waves = [
                        np.asarray(_moved(part, self.actuator, part.filled(w, 1)))[:, : w.shape[1]]
                        for (part, _), w in zip(self.parts, waves, strict=True)
                    ]
                lines = [np.einsum("rln,crn->crl", read[:, :, at], w, optimize=True) for read, w in zip(self.read, waves, strict=True)]
        lines = as_lines(np.concatenate(lines, axis=1)[:, np.asarray(self.predictor.index)])
        return self.problem.passes.change(lines).T

    def _waves(self, term, signals):
        own = [signals[v.removesuffix(DIRECTION)] for v in term.variables]
        turned = zip(own, term.knee, turning(term.variables), strict=True)
        return term.basis(*(np.asarray(_directions(x, travel)) if turns else x for x, travel, turns in turned), xp=np)[0]

    def project(self, columns) -> np.ndarray:
        """The part of data columns that the fit cannot make."""
        whole = np.concatenate([columns, np.zeros((len(self.projector.raw) - self.projector.count, columns.shape[1]))])
        for _ in range(2):
            whole = whole - self.projector.basis @ (self.projector.basis.T @ whole)
        return whole


def evidence(columns, residual, counts, freedom: float):
    """Best (evidence over no term, share of the misfit explained, length, size relative to the columns').

    The linear model residual + columns c = noise, c ~ size^2 deviation^2, the noise of unit variance or as much larger
    as the residual says: a misfit in the thousands must not be taken for knowledge.
    """
    normal, push = columns.T @ columns, columns.T @ residual
    total = float(residual @ residual)

    def gain(values, along, variance):
        left = total - float(np.sum(variance * along**2 / (1 + variance * values)))
        noise = max(left / freedom, 1.0)
        return -0.5 * freedom * np.log(noise) - 0.5 * left / noise - 0.5 * float(np.sum(np.log1p(variance * values))), left

    flat = max(total / freedom, 1.0)
    nothing = -0.5 * freedom * np.log(flat) - 0.5 * total / flat
    best = (-np.inf, 0.0, 0.0, 0.0)
    for length in LENGTHS:
        deviation = prior_deviations(counts, length)
        values, vectors = np.linalg.eigh(normal * deviation * deviation[:, None])
        values, along = np.maximum(values, 0.0), vectors.T @ (push * deviation)
        for size in np.geomspace(1e-3, 1e3, 37):
            found, left = gain(values, along, size**2)
            if found - nothing > best[0]:
                best = (found - nothing, 1 - left / total, length, size)
    return tuple(float(b) for b in best)


def applicable_sets(actuator, signals, quasistatic: bool):
    """Boundaries and variables that this actuator has, with the numbers of cosines to try."""
    for block, variables, counts in (*((*p, _resolutions(*p)) for p in SETS), *((*p, _of_one(p[0])) for p in FACTORS)):
        if block in ("magnetostriction", "mechanics") and getattr(actuator, block) is None:
            continue
        if block == "coil" and actuator.coil.drive == "voltage":
            continue
        if any(v not in signals or np.ptp(signals[v]) == 0 for v in (v.removesuffix(DIRECTION) for v in variables)):
            continue
        if quasistatic and any(v.endswith("_rate") for v in variables):
            continue
        yield block, variables, counts


def locate_places(result, say=lambda *a: None) -> list[Place]:
    """Every boundary with its variables by the evidence of a smooth function there, best first."""
    tangents = Tangents(result)
    residual = tangents.projector.residual
    freedom = max(len(residual) - tangents.projector.basis.shape[1], 10)
    found = []
    for block, variables, tried in applicable_sets(tangents.actuator, tangents.signals, tangents.problem.quasistatic):
        say(f"a function of {' and '.join(variables)} at the {block}", 0, None)
        for counts, travel in itertools.product(tried, TRAVELS if any(turning(variables)) else TRAVELS[:1]):
            term = null_term(block, variables, tangents.signals, tangents.actuator, counts, travel)
            columns = tangents.columns(term)
            if not np.isfinite(columns).all():
                continue
            off = tangents.project(columns)
            gain, share, length, size = evidence(off, residual, counts, freedom)
            if length == 0.0:
                continue
            weighed = prior_deviations(counts, length)
            visible = float(np.linalg.norm(off * weighed) / max(np.linalg.norm(columns * weighed), 1e-300))
            if found and found[-1].variables == variables and found[-1].block == block:
                if gain < found[-1].evidence + FINER_GAIN:
                    continue
                found.pop()
            found.append(
                Place(block, variables, gain, share, length, size * float(term.size), visible, _with_prior(term, length, size))
            )
    return sorted(found, key=lambda p: -p.evidence)


def _with_prior(term, length, size=1.0):
    deviation = prior_deviations(term.counts, length)
    return dataclasses.replace(term, deviation=jnp.asarray(deviation), size=term.size * size)


def _resolutions(block, variables):
    if is_reversible(block, variables):
        return [(ONE,)]
    if block in ("coil", "hysteresis"):
        return [IN_STEP if len(variables) == 2 else (2 * IN_STEP[0],)]
    if len(variables) == 2:
        return [TWO]
    return [(ONE,), (FINE,)] if block in ("sensor", "magnetostriction") and not variables[0].endswith("_rate") else [(ONE,)]


def _of_one(block):
    return [(2 * IN_STEP[0] if block in ("coil", "hysteresis") else ONE, 1)]
