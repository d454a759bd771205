"""any block: a smooth function of one or two local variables, learned from recordings that no named effect explains.

It is not of the catalogue: nothing is named by it. A diagnosis that ends in `unknown_at` fits it, so that the model
predicts what it cannot explain, and states how far its function is known.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ..param import ParameterInfo, as_float_array
from .base import AbstractEffect
from .forces import with_force

DIRECTION = "_direction"  # of a signal, -1 falling to 1 rising: turned by a travel, its `knee`
PAD = 0.15  # of the range seen, by which the cosines' own period reaches beyond it: no slope is forced at its ends
UNITS = {
    "current": "A", "current_rate": "A/s", "field": "A/m", "field_rate": "A/m/s", "magnetization": "A/m", "magnetization_rate": "A/m/s",
    "flux_rate": "T/s", "displacement": "m", "displacement_rate": "m/s", "stretch": "m", "reading": "reading", "reading_rate": "reading/s",
    "magnetization_direction": "1", "displacement_direction": "1", "reading_direction": "1",
}  # fmt: skip
PLACES = {
    "source": ("current", "current_rate"),
    "coil": ("flux_rate", "magnetization", "field", "current"),
    "hysteresis": ("field", "magnetization", "field_rate"),
    "magnetostriction": ("magnetization", "field", "magnetization_rate", "field_rate", "magnetization_direction"),
    "mechanics": ("displacement", "displacement_rate", "magnetization", "stretch", "displacement_direction"),
    "sensor": ("reading", "reading_rate", "current", "current_rate", "magnetization", "flux_rate", "reading_direction"),
}
OUTPUTS = {"source": "A", "coil": "A/m", "hysteresis": "A/m", "magnetostriction": "m", "mechanics": "m", "sensor": "reading"}


def is_reversible(place, variables) -> bool:
    """Whether a term there is a magnetization of its own: a shift of the relays' field by the field alone would be another density."""
    return place == "hysteresis" and tuple(variables) == ("field",)


def turning(variables) -> tuple[bool, ...]:
    """Which of some variables are the directions of a signal."""
    return tuple(v.endswith(DIRECTION) for v in variables)


def direction_of(signal, travel, line):
    """Which way a signal goes, -1 falling to 1 rising, (time,): after a turn it comes round by P. Dahl's law (AIAA J. 14 (1976) 1675)
    within `travel`, however fast."""

    def follow(state, now):
        turned, before = state
        moved = now - before
        end = jnp.sign(moved)
        turned = end + (turned - end) * jnp.exp(-jnp.abs(moved) / travel)
        return (turned, now), turned

    start = jnp.zeros_like(signal[0]), signal[0]
    if line.periodic:
        start, _ = jax.lax.scan(follow, start, signal)
    return jax.lax.scan(follow, start, signal)[1]


def _products(counts, along, xp):
    """Every product of cosines of multiples of the angles `along`, (coefficients, ...); a variable of one wave is a factor."""
    product = None
    for at, count in zip(along, counts, strict=True):
        waves = at[None] if count == 1 else xp.cos(xp.arange(count).reshape((count,) + (1,) * at.ndim) * at)
        product = waves if product is None else (product[:, None] * waves[None]).reshape((-1, *at.shape))
    return product


def _recurred(counts, coefficients, along):
    """The sum of coefficients times `_products`, by C. W. Clenshaw's recurrence (Math. Tables Aids Comput. 9 (1955) 118): one cosine a
    variable."""
    rows = coefficients.reshape(*counts, *(1,) * jnp.ndim(along[0]))
    for at, count in zip(along, counts, strict=True):  # whose rows come first of those that are left
        if count == 1:
            rows = rows[0] * at
            continue
        twice, here, before = 2 * jnp.cos(at), 0.0, 0.0
        for row in rows[:0:-1]:
            here, before = row + twice * here - before, here
        rows = rows[0] + 0.5 * twice * here - before
    return rows


_series = jax.custom_jvp(_recurred, nondiff_argnums=(0,))


def _changed(counts, given, tangents):
    """The sum and its change: by a slope for each angle, by the cosines for the coefficients, both known before a direction is."""
    (coefficients, along), (by_coefficients, by_angle) = given, tangents
    value, change = _recurred(counts, coefficients, along), 0.0
    for k, (at, towards) in enumerate(zip(along, by_angle, strict=True)):
        if type(towards) is not SymbolicZero:
            there = lambda x, k=k: _recurred(counts, coefficients, (*along[:k], x, *along[k + 1 :]))  # noqa: E731
            change = change + jax.jvp(there, (at,), (jnp.ones_like(at),))[1] * towards
    if type(by_coefficients) is not SymbolicZero:
        change = change + jnp.tensordot(by_coefficients, _products(counts, along, jnp), 1)
    return value, change + jnp.zeros_like(value)


_series.defjvp(_changed, symbolic_zeros=True)


class LearnedTerm(AbstractEffect):
    """What a block adds to its output: size * sum of coefficients * products of cosines in scaled variables.

    A variable x is scaled to s in 0..1 over the range seen, `low` to `high`, rates as arsinh(x / knee); the cosines are
    cos(k pi (s + PAD)/(1 + 2 PAD)). A variable of one wave is a factor, x over its largest value: a loss per rate, a damping,
    a lag behind the way that a signal goes (`direction_of`).
    Beyond the range the function stays as at its edge, plus `beyond` times the scaled distance: zero, but uncertain.
    `deviation`: prior standard deviation of each coefficient, which falls with k as the spectrum of a smooth random
    function. Added: to the current (A), to the loss or to the relays' field (A/m), a function of that field alone to the
    magnetization (A/m), to the free displacement (m), as a force in metres of free displacement, or to the reading.
    """

    coefficients: tuple[Float[Array, ""], ...]
    deviation: Float[Array, " coefficients"]
    low: Float[Array, " variables"]
    high: Float[Array, " variables"]
    knee: Float[Array, " variables"]
    size: Float[Array, ""]
    beyond: Float[Array, " ends"]
    place: str = eqx.field(static=True)
    variables: tuple[str, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    name: ClassVar[str] = "learned_term"
    law: ClassVar[str] = "x -> x + size sum_k c_k prod_v cos(k_v pi (s_v + PAD)/(1 + 2 PAD))"
    source: ClassVar[str] = "A. Solin, S. Sarkka, Stat. Comput. 30 (2020) 419: Gaussian processes by cosines of a longer range"
    signature: ClassVar[str] = "what no named effect explains"
    amplitude: ClassVar[str] = "c0"

    @staticmethod
    def null(place, variables, low, high, counts, deviation, size, knee=None, beyond=None, coefficients=None) -> "LearnedTerm":
        """A term of given place and variables whose coefficients are zero unless given."""
        number = int(np.prod(counts))
        values = np.zeros(number) if coefficients is None else np.asarray(coefficients, float)
        return LearnedTerm(
            tuple(as_float_array(v) for v in values), as_float_array(deviation), as_float_array(low), as_float_array(high),
            as_float_array(np.zeros(len(variables)) if knee is None else knee), as_float_array(size),
            as_float_array(np.zeros(2 * len(variables)) if beyond is None else beyond), str(place), tuple(variables), tuple(int(c) for c in counts),
        )  # fmt: skip

    def settings(self) -> dict:
        """All of it but the coefficients, for model.json."""
        arrays = {n: np.asarray(getattr(self, n)).tolist() for n in ("deviation", "low", "high", "knee", "size", "beyond")}
        return {"place": self.place, "variables": list(self.variables), "counts": list(self.counts), **arrays}

    @property
    def block(self) -> str:
        """The block at whose output it adds."""
        return self.place

    @property
    def in_step(self) -> bool:
        """Whether it is solved inside the step of (4)."""
        return self.place in ("coil", "hysteresis")

    def __getattr__(self, name):
        """A coefficient by the name of its parameter, c0, c1, ..."""
        if name[:1] == "c" and name[1:].isdigit() and int(name[1:]) < len(self.coefficients):
            return self.coefficients[int(name[1:])]
        raise AttributeError(f"learned_term has no {name}")

    def parameters(self) -> dict:
        """c0, c1, ...: held by their prior deviation (a shape has two of its scales)."""
        meaning = "coefficient of the learned function"
        return {
            f"c{k}": ParameterInfo("1", meaning, scale=0.5 * float(d), null=0.0, shape=True)
            for k, d in enumerate(np.asarray(self.deviation))
        }

    def basis(self, *values, xp=jnp):
        """Every product of cosines at some values, (coefficients, ...), and the scaled distances beyond, (ends, ...).

        `xp`: jax.numpy or numpy."""
        along, outside = self._scaled(values, xp)
        return _products(self.counts, along, xp), xp.stack(outside)

    def _scaled(self, values, xp):
        """Of every variable the angle of its first cosine, or what it is as a factor; and the scaled distances beyond."""
        along, outside = [], []
        for x, low, high, knee, count in zip(values, self.low, self.high, self.knee, self.counts, strict=True):
            low, high, knee = (xp.asarray(v) for v in (low, high, knee))
            if count == 1:
                along.append(x / xp.maximum(xp.abs(low), xp.abs(high)))
                outside += [xp.zeros_like(x)] * 2
                continue
            width = xp.where(knee > 0, knee, 1.0)
            x, low, high = (xp.where(knee > 0, xp.arcsinh(v / width), v) for v in (x, low, high))
            s = (x - low) / (high - low)
            outside += [xp.maximum(-s, 0.0), xp.maximum(s - 1.0, 0.0)]
            along.append((xp.clip(s, 0.0, 1.0) + PAD) * (np.pi / (1 + 2 * PAD)))
        return along, outside

    def value(self, *values):
        """The function at some values of its variables, unit of the block's output.

        A step asks for it many times: see `_series`.
        """
        along, outside = self._scaled(values, jnp)
        series = _series(self.counts, jnp.stack(self.coefficients), tuple(along))
        return self.size * (series + sum(b * x for b, x in zip(self.beyond, outside, strict=True)))

    @property
    def reversible(self) -> bool:
        """Whether it is a magnetization that the field has at once, beside the relays'."""
        return is_reversible(self.place, self.variables)

    def _of(self, table, line=None):
        signals = [table[v.removesuffix(DIRECTION)]() for v in self.variables]
        turned = zip(signals, self.knee, turning(self.variables), strict=True)
        return self.value(*(direction_of(x, travel, line) if turns else x for x, travel, turns in turned))

    def drive(self, current, line, actuator):
        """Current with the term, A."""
        if self.place != "source":
            return current
        return current + self._of({"current": lambda: current, "current_rate": lambda: line.derivative(current)})

    def field_shift(self, trial, state, actuator):
        """Loss (coil) or shift of the relays' field (hysteresis), A/m."""
        return jnp.zeros_like(trial.field) if self.reversible else self._of_trial(trial)

    def magnetization(self, trial, state, actuator):
        """What a reversible one adds to the relays' M, A/m."""
        return self._of_trial(trial) if self.reversible else jnp.zeros_like(trial.field)

    def _of_trial(self, trial):
        return self._of(
            {
                "field": lambda: trial.field, "magnetization": lambda: trial.magnetization, "flux_rate": lambda: trial.flux_rate,
                "field_rate": lambda: trial.field_rate, "current": lambda: trial.current,
            }
        )  # fmt: skip

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with the term, m."""
        if self.place != "magnetostriction":
            return free_displacement
        return free_displacement + self._of(
            {
                "magnetization": lambda: magnetization, "field": lambda: field,
                "magnetization_rate": lambda: line.derivative(magnetization), "field_rate": lambda: line.derivative(field),
            },
            line,
        )  # fmt: skip

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement under the term as a force, m."""
        if self.place != "mechanics":
            return displacement

        def force(y, term, series):
            magnetization, free = series
            return term._of(
                {
                    "displacement": lambda: y, "displacement_rate": lambda: line.derivative(y), "magnetization": lambda: magnetization,
                    "stretch": lambda: y - free,
                },
                line,
            )  # fmt: skip

        local = {"displacement", "magnetization", "stretch"}.issuperset(self.variables)
        return with_force(displacement, force, self, (signals["magnetization"], free_displacement), line, actuator, local)

    def reading(self, reading, signals, line, actuator):
        """Reading with the term."""
        if self.place != "sensor":
            return reading
        current = signals["current"]
        return reading + self._of(
            {
                "reading": lambda: reading, "reading_rate": lambda: line.derivative(reading), "current": lambda: current,
                "current_rate": lambda: line.derivative(current), "magnetization": lambda: signals["magnetization"],
                "flux_rate": lambda: line.derivative(signals["flux_density"]),
            },
            line,
        )  # fmt: skip
