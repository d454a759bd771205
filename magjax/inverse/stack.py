"""The voltage for a wanted displacement of a piezo stack: P by its linear law, then chi V + Gamma[V] = P exactly, in NumPy."""

import dataclasses

import numpy as np

from ..errors import ConfigurationError
from .dynamic import free_displacement, undo_sensor
from .operator import PlainPreisach

KNOWN_INVERSES = ("amplifier_lag", "second_mode")


@dataclasses.dataclass(frozen=True)
class PlainStack:
    """The numbers of a stack without JAX. SI; `effects`: name -> {parameter: value}; f0 infinite where no mechanics is stated."""

    operator: PlainPreisach
    stroke: float
    V_m: float
    chi: float
    f0: float = np.inf
    xi: float = 0.0
    effects: dict = dataclasses.field(default_factory=dict)

    @staticmethod
    def from_actuator(actuator) -> "PlainStack":
        """From any object with the attributes of `magjax.actuator.Actuator`. Raises `ConfigurationError` where no displacement is read."""
        if actuator.output != "displacement":
            raise ConfigurationError("only a stack whose displacement is read can be inverted for a displacement")
        h, p, s = actuator.hysteresis.rested(), actuator.piezo, actuator.mechanics
        operator = PlainPreisach(np.asarray(h.masses), float(h.low), float(h.high), float(h.offset), np.asarray(h.history))
        effects = {e.name: {n: float(np.asarray(getattr(e, n))) for n in e.parameters()} for e in actuator.effects}
        mechanics = () if s is None else (float(s.f0), float(s.xi))
        return PlainStack(operator, float(p.stroke), float(p.V_m), float(p.chi), *mechanics, effects=effects)

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest free displacement over the voltages of the plane, m."""
        o = self.operator
        ends = (self.chi * o.low + o.offset - o.total, self.chi * o.high + o.offset + o.total)
        return tuple(self.stroke / self.V_m * e for e in ends)


def voltage_for_displacement(plant: PlainStack, displacement, h: float, of_reading: bool = False):
    """The voltage to apply, V, (time,), for a wanted displacement, m, (time,), at steps of `h`, s.

    `of_reading`: the trajectory is wanted of the sensor's reading. Returns (voltage, samples beyond the voltages of the plane,
    where its nearest end is taken). Of the effects those in `KNOWN_INVERSES` are compensated.
    """
    y = undo_sensor(plant, displacement, h) if of_reading else np.asarray(displacement, float)
    operator, voltage, beyond = plant.operator.copy(), [], []
    for P in plant.V_m / plant.stroke * free_displacement(plant, y, h):
        V = operator.solve(float(P), plant.chi)
        beyond.append(not operator.low <= V <= operator.high)
        voltage.append(min(max(V, operator.low), operator.high))
    voltage = np.array(voltage)
    if "amplifier_lag" in plant.effects:
        lag = plant.effects["amplifier_lag"]
        change = lag["tau"] * np.diff(voltage, prepend=voltage[0]) / h
        voltage = voltage + change + lag.get("order2", 0.0) * lag["tau"] * np.diff(change, prepend=change[0]) / h
    return voltage, np.array(beyond)
