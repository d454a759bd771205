"""The dynamic model and its inverse in NumPy: implicit Euler steps of (4), the inverse (7), the current for a displacement.

An implicit Euler step of (4) is the same algorithm as the inverse, with slope 1 + h c1/c0: no Newton iteration.
"""

import dataclasses

import numpy as np

from ..errors import ConfigurationError
from .operator import PlainPreisach

MU0 = 4e-7 * np.pi
KNOWN_INVERSES = ("amplifier_lag",)


@dataclasses.dataclass(frozen=True)
class PlainActuator:
    """The numbers of an actuator without JAX. SI; `effects`: name -> {parameter: value}."""

    operator: PlainPreisach
    R_eddy: float
    c0: float
    H_bias: float
    N_m: float
    A_m: float
    lambda_s: float
    M_s: float
    l_rod: float
    f0: float
    xi: float
    effects: dict = dataclasses.field(default_factory=dict)

    @property
    def c1(self) -> float:
        """c1 of (4), 1/(A s) times A/m."""
        return self.R_eddy / (MU0 * self.N_m * self.A_m)

    @staticmethod
    def from_actuator(actuator) -> "PlainActuator":
        """From any object with the attributes of `magjax.actuator.Actuator`."""
        if getattr(actuator, "mechanics", None) is None or not hasattr(actuator.coil, "R_eddy"):
            raise ConfigurationError("only a current-driven bench with mechanics can be inverted for a displacement")
        h, c, m, s = actuator.hysteresis.rested(), actuator.coil, actuator.magnetostriction, actuator.mechanics
        operator = PlainPreisach(np.asarray(h.masses), float(h.low), float(h.high), float(h.offset), np.asarray(h.history))
        effects = {e.name: {p: float(np.asarray(getattr(e, p))) for p in e.parameters()} for e in actuator.effects}
        numbers = (c.R_eddy, c.c0, c.H_bias, c.N_m, c.A_m, m.lambda_s, m.M_s, m.l_rod, s.f0, s.xi)
        return PlainActuator(operator, *(float(v) for v in numbers), effects)


def implicit_euler(plant: PlainActuator, current, h: float, operator=None):
    """Solve (4) by implicit Euler steps, exactly: (field, magnetization) over time, A/m."""
    operator = plant.operator.copy() if operator is None else operator
    H = plant.c0 * float(current[0]) + plant.H_bias
    M = operator.apply(H)
    fields, magnetizations = [H], [M]
    gain = h * plant.c1
    for I in current[1:]:
        H = operator.solve(H + M + gain * (float(I) + plant.H_bias / plant.c0), 1 + gain / plant.c0)
        M = operator.magnetization
        fields.append(H)
        magnetizations.append(M)
    return np.array(fields), np.array(magnetizations)


def feasible_magnetization(plant: PlainActuator, displacement, h: float):
    """M_bar = sqrt(u_bar) of (5) for a wanted displacement, and which samples had to be made feasible.

    u_bar = M_s^2/(l_rod lambda_s) (y'' / w0^2 + 2 xi y'/w0 + y) must lie in [0, M_s^2]; the nearest value that does
    is taken elsewhere.
    """
    y = np.asarray(displacement, float)
    w0 = 2 * np.pi * plant.f0
    speed = np.gradient(y, h)
    force = np.gradient(speed, h) / w0**2 + 2 * plant.xi / w0 * speed + y
    square = force / (plant.l_rod * plant.lambda_s)
    return plant.M_s * np.sqrt(np.clip(square, 0.0, 1.0)), (square < 0) | (square > 1)


def current_for_displacement(plant: PlainActuator, displacement, h: float):
    """The current to apply, A, by the inverse (7), with the secant of M: exact for the implicit Euler model.

    Returns (current, infeasible samples, saturated samples). Of the effects, those in `KNOWN_INVERSES` are compensated.
    """
    wanted, infeasible = feasible_magnetization(plant, displacement, h)
    operator = plant.operator.copy()
    fields, magnetizations, saturated = [], [], []
    for m in wanted:
        fields.append(operator.solve(float(m)))
        magnetizations.append(operator.magnetization)
        saturated.append(operator.saturated)
    H, M = np.array(fields), np.array(magnetizations)
    rate = np.concatenate([[0.0], np.diff(H + M)]) / h
    current = rate / plant.c1 + (H - plant.H_bias) / plant.c0
    if "amplifier_lag" in plant.effects:
        current = current + plant.effects["amplifier_lag"]["tau"] * np.concatenate([[0.0], np.diff(current)]) / h
    return current, infeasible, np.array(saturated)
