"""The actuator: the blocks of the chain and a tuple of effects. It holds physical values in SI.

A bench with fewer blocks leaves later ones out (None): a rod in a coil ends at flux density B = mu0 (H + M). A piezo stack has
electrodes for a coil and a piezo for the magnetostriction.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .chain import BLOCKS, Coil, Electrodes, FieldCoil, Magnetostriction, Mechanics, Piezo, Sensor, Source
from .effects import SensorLag
from .effects.base import AbstractEffect
from .errors import ConfigurationError
from .param import in_numpy, parameters_of
from .preisach import Preisach, gaussian_lorentzian_masses
from .terms import Terms, terms_of


class Actuator(eqx.Module):
    """source -> coil <-> hysteresis -> magnetostriction -> mechanics -> sensor, and the effects that act on them.

    `output`: the quantity that the sensor reads: "displacement", "flux_density", "magnetization" or "polarization".
    """

    coil: Coil | FieldCoil | Electrodes
    hysteresis: Preisach
    magnetostriction: Magnetostriction | None = None
    mechanics: Mechanics | None = None
    source: Source = eqx.field(default_factory=Source)
    sensor: Sensor = eqx.field(default_factory=Sensor)
    effects: tuple[AbstractEffect, ...] = ()
    output: str = eqx.field(static=True, default="displacement")
    piezo: Piezo | None = None

    @property
    def strained(self) -> Magnetostriction | Piezo | None:
        """The block that makes a free displacement of M, None where there is none."""
        return self.magnetostriction if self.piezo is None else self.piezo

    @property
    def terms(self) -> Terms:
        """The words and units in which this actuator is spoken of."""
        return terms_of(self.coil.drive)

    def with_effect(self, effect: AbstractEffect) -> "Actuator":
        """The same actuator with one more effect; an effect of the same name is replaced.

        Effects stand in the order of the catalogue, whatever the order in which they are added: within a block each acts on
        what the one before it leaves. Those that are in no catalogue come last.
        """
        from .effects import CATALOGUE

        if not effect.serves(self):
            raise ConfigurationError(f"{effect.name} acts in a rod or its coil; a stack under voltage has neither: leave it out")
        rank = {c.name: k for k, c in enumerate(CATALOGUE)}
        kept = [e for e in self.effects if e.name != effect.name]
        return dataclasses.replace(self, effects=tuple(sorted((*kept, effect), key=lambda e: rank.get(e.name, len(rank)))))

    def without_effect(self, name: str) -> "Actuator":
        """The same actuator without the effect of that name."""
        return dataclasses.replace(self, effects=tuple(e for e in self.effects if e.name != name))

    def effect(self, name: str) -> AbstractEffect:
        """The effect of that name; raises `ConfigurationError` where there is none."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise ConfigurationError(f'the actuator has no effect "{name}"; it has {[e.name for e in self.effects]}')

    def parameters(self) -> dict:
        """Every declared scalar parameter: "block.name" or "effects.effect.name" -> (value, ParameterInfo)."""
        found = {}
        for block in BLOCKS:
            module = getattr(self, block)
            if module is None or block == "hysteresis":
                continue
            for name, info in parameters_of(module).items():
                if name == ("stroke" if self.output == "polarization" else "P_m"):  # a stack's other full scale
                    continue
                found[f"{block}.{name}"] = (getattr(module, name), info)
        for effect in self.effects:
            for name, info in effect.parameters().items():
                info = dataclasses.replace(info, unit=self.terms.unit_of(info.unit))
                found[f"effects.{effect.name}.{name}"] = (getattr(effect, name), info)
        return found

    def replace(self, values: dict) -> "Actuator":
        """New parameter values by name, as in `parameters`; "hysteresis.masses" and ".offset" too."""
        changed = self
        for name, value in values.items():
            where = _getter(changed, name)
            changed = eqx.tree_at(where, changed, jnp.asarray(value, dtype=float))
        return changed

    def remembering(self, history, raised: float = 0.0) -> "Actuator":
        """The actuator after a history of fields, A/m, from negative saturation, with M `raised`, A/m, as by relays out of reach."""
        h = self.hysteresis
        state = (jnp.asarray(history, dtype=float), h.low, h.offset + raised)
        return eqx.tree_at(lambda a: (a.hysteresis.history, a.hysteresis.rest, a.hysteresis.offset), self, state)

    def describe(self) -> str:
        """The parameters in words, a line each."""
        lines = [
            f"  {name:34s} {float(np.asarray(value)):12.6g} {info.unit:14s} {info.meaning}"
            for name, (value, info) in self.parameters().items()
        ]
        masses = np.asarray(self.hysteresis.masses)
        low, high, terms = float(self.hysteresis.low), float(self.hysteresis.high), self.terms
        plane = f"  hysteresis: L = {masses.shape[0]}, {low:.6g}..{high:.6g} {terms.unit}"
        return "\n".join([f"Actuator, {self.output} out", *lines, f"{plane}, sum of masses {masses.sum():.6g} {terms.state_unit}"])


def _getter(actuator, name: str):
    parts = name.split(".")
    if parts[0] == "effects" and len(parts) == 3:
        index = [e.name for e in actuator.effects].index(parts[1]) if parts[1] in [e.name for e in actuator.effects] else None
        if index is not None:
            return lambda a: getattr(a.effects[index], parts[2])
    elif len(parts) == 2 and hasattr(getattr(actuator, parts[0], None), parts[1]):
        return lambda a: getattr(getattr(a, parts[0]), parts[1])
    known = [*actuator.parameters(), "hysteresis.masses", "hysteresis.offset"]
    raise ConfigurationError(f'no parameter "{name}"; there are {", ".join(known)}')


def tan_baras_density(cells: int = 25, low: float = 0.0, high: float = 2.6e4, total: float = 7.87e5 / 2) -> np.ndarray:
    """Masses of a plausible Terfenol-D rod for T&B's bench, whose Fig. 5 gives no numbers: Gaussian x Lorentzian."""
    return gaussian_lorentzian_masses(cells, low, high, total, 0.42 * (low + high), 0.22 * (high - low), 900.0, 1100.0)


def from_bench(bench) -> Actuator:
    """The actuator that a bench file describes, with a starting density on the plane that its limits can reach."""
    constants = bench.constants
    _check_bench(bench)

    def block(kind, prefix):
        names = parameters_of(kind)
        return kind(**{n: constants[f"{prefix}.{n}"] for n in names if f"{prefix}.{n}" in constants})

    coil = Electrodes() if bench.drive == "voltage" else block(FieldCoil if bench.drive == "field" else Coil, "coil")
    magnetostriction = block(Magnetostriction, "magnetostriction") if "magnetostriction" in bench.blocks else None
    piezo = block(Piezo, "piezo") if bench.drive == "voltage" else None
    mechanics = block(Mechanics, "mechanics") if "mechanics" in bench.blocks else None
    low, high = _plane(bench, coil)
    cells = int(bench.levels)
    strained = magnetostriction if piezo is None else piezo
    M_s = float(strained.M_s) if strained is not None else 1e6
    start = bench.start if bench.start != "auto" else "negative_saturation"
    switched = 0.5 * M_s if piezo is None else 0.1 * M_s
    masses = tan_baras_density(cells, low, high, switched)
    hysteresis = Preisach(masses, low, high, switched, start)
    known = (SensorLag(constants["sensor.tau"], constants.get("sensor.order2", 0.0)),) if "sensor.tau" in constants else ()
    return Actuator(
        coil,
        hysteresis,
        magnetostriction,
        mechanics,
        sensor=block(Sensor, "sensor"),
        effects=known,
        output=bench.output,
        piezo=piezo,
    )


def _check_bench(bench):
    """What a bench file alone does not tell: whether there is a coil to drive, and which effects its priors speak of."""
    from .effects import CLASSES, forms_of

    if bench.drive != "voltage" and not any(name.startswith("coil.") for name in bench.constants):
        raise ConfigurationError(
            f"bench {bench.source or bench.name}: has no [coil], so nothing to drive; state one (see docs/parameters.md)"
        )
    known = {f"effects.{name}.{p}" for name in CLASSES for form in forms_of(name) for p in form.parameters()}
    for name in bench.priors:
        if name.startswith("effects.") and name not in known:
            raise ConfigurationError(
                f'bench {bench.source or bench.name}: fit.priors names "{name}", which no effect has (see docs/parameters.md)'
            )


def _plane(bench, coil):
    """Range of the Preisach plane, A/m (V): what the limit of the drive reaches on either side of the bias."""
    largest = float(bench.limit or {"current": 0.9, "field": 300.0, "voltage": 150.0}[bench.drive])
    ends = [float(in_numpy(coil).applied_field(sign * largest)) for sign in (-1, 1)]
    margin = 0.01 * (ends[1] - ends[0])
    return ends[0] - margin, ends[1] + margin
