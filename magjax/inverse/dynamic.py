"""The dynamic model and its inverse in NumPy: implicit Euler steps of (4), the inverse (7), the current for a displacement.

An implicit Euler step of (4) is the same algorithm as the inverse, with slope 1 + h c1/c0: no Newton iteration.
"""

import dataclasses

import numpy as np

from ..errors import ConfigurationError
from .operator import PlainPreisach

MU0 = 4e-7 * np.pi
KNOWN_INVERSES = ("amplifier_lag", "excess_loss", "quartic_magnetostriction", "second_mode")
SENSOR_INVERSES = ("sensor_lag", "transport_delay")  # undone where the reading is to follow; the motion does not need it


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
            raise ConfigurationError(
                "this needs a bench with mechanics that is driven by a current (of a piezo stack magjax invert gives the voltage)"
            )
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


def second_mode_force(plant: PlainActuator, displacement, h: float):
    """The free displacement that makes both modes together follow `displacement`, over the whole trajectory at once.

    U = Y / (G + gain (G2 - G + lead (s / w2) (G2 - (w2 / w0)^2 G))) on a padded FFT: at rest before, and smoothly on (point-mirrored) after the end.
    """
    mode = plant.effects["second_mode"]
    y = np.asarray(displacement, float)
    pad = max(len(y), int(2.0 / (plant.f0 * h)))
    after = 2 * y[-1] - y[-2::-1]
    back = after[-1] + (y[0] - after[-1]) * 0.5 * (1 - np.cos(np.pi * np.arange(pad) / pad))
    whole = np.concatenate([np.full(pad, y[0]), y, after, back])
    s = 2j * np.pi * np.fft.rfftfreq(len(whole), h)
    w, w2 = 2 * np.pi * plant.f0, 2 * np.pi * mode["f2"]
    first = w**2 / (s * s + 2 * plant.xi * w * s + w**2)
    second = w2**2 / (s * s + 2 * mode["xi2"] * w2 * s + w2**2)
    quiet = np.abs(s) < 2 * np.pi * 20 * max(plant.f0, mode["f2"])  # beyond, differentiating twice only lifts rounding
    beside = second - first + mode.get("lead", 0.0) * s / w2 * (second - (w2 / w) ** 2 * first)
    U = np.where(quiet, np.fft.rfft(whole) / (first + mode["gain"] * beside), 0.0)
    return np.fft.irfft(U, len(whole))[pad : pad + len(y)]


def with_second_mode(plant, rod, second) -> float:
    """The displacement, m, of the states [y, dy/dt] of both modes under one force; that of the first where the plant has no other."""
    mode = plant.effects.get("second_mode")
    if mode is None:
        return rod[0]
    w, w2 = 2 * np.pi * plant.f0, 2 * np.pi * mode["f2"]
    of_rate = second[1] / w2 - w2 / w**2 * rod[1]
    return rod[0] + mode["gain"] * (second[0] - rod[0] + mode.get("lead", 0.0) * of_rate)


def free_displacement(plant, displacement, h: float):
    """y'' / w0^2 + 2 xi y' / w0 + y of (5), m: what the material must do for a wanted displacement; a second mode of the plant too."""
    y = np.asarray(displacement, float)
    if "second_mode" in plant.effects:
        return second_mode_force(plant, y, h)
    w0, speed = 2 * np.pi * plant.f0, np.gradient(y, h)
    return np.gradient(speed, h) / w0**2 + 2 * plant.xi / w0 * speed + y


def feasible_magnetization(plant: PlainActuator, displacement, h: float):
    """M_bar = sqrt(u_bar) of (5) for a wanted displacement, and which samples had to be made feasible.

    u_bar = M_s^2/(l_rod lambda_s) (y'' / w0^2 + 2 xi y'/w0 + y) must lie in [0, M_s^2]; the nearest value that does
    is taken elsewhere. A second mode and a quartic law of the plant are inverted too.
    """
    square = free_displacement(plant, displacement, h) / (plant.l_rod * plant.lambda_s)
    wrong = (square < 0) | (square > 1)
    return magnetization_for(plant, square), wrong


def magnetization_for(plant: PlainActuator, strain):
    """M >= 0, A/m, of a strain in units of lambda_s, by the quadratic law or the plant's quartic one; the ends outside [0, 1]."""
    strain = np.clip(strain, 0.0, 1.0)
    b = plant.effects.get("quartic_magnetostriction", {}).get("b", 0.0)
    if b:  # m^2 + b (m^4 - m^2) = strain, without cancellation
        root = np.sqrt(np.maximum((1 - b) ** 2 + 4 * b * strain, 0.0))
        strain = np.clip(2 * strain / np.maximum(1 - b + root, 1e-300), 0.0, 1.0)
    return plant.M_s * np.sqrt(strain)


def nearest_feasible(plant: PlainActuator, displacement, h: float):
    """The displacement, m, that the feasible M_bar of `feasible_magnetization` really leads to, starting at rest.

    Equal to `displacement` (to the differences' error) where that is feasible; offered where it is not.
    """
    from .events import oscillate

    M, _ = feasible_magnetization(plant, displacement, h)
    m2 = (M / plant.M_s) ** 2
    b = plant.effects.get("quartic_magnetostriction", {}).get("b", 0.0)
    free = plant.l_rod * plant.lambda_s * (m2 + b * (m2 * m2 - m2))
    mode = plant.effects.get("second_mode")
    rod, second, reached = [free[0], 0.0], [free[0], 0.0], []
    for k, after in enumerate(free):
        if k:
            rod = oscillate(rod, free[k - 1], after, h, plant.f0, plant.xi)
            second = second if mode is None else oscillate(second, free[k - 1], after, h, mode["f2"], mode["xi2"])
        reached.append(with_second_mode(plant, rod, second))
    return np.array(reached)


def undo_sensor(plant: PlainActuator, reading, h: float):
    """The displacement whose reading is wanted: lag and delay of the sensor taken out."""
    y = np.asarray(reading, float)
    lag = plant.effects.get("sensor_lag")
    if lag is not None:
        speed = np.gradient(y, h)
        y = y + lag["tau"] * speed + lag["order2"] * lag["tau"] ** 2 * np.gradient(speed, h)
    if "transport_delay" in plant.effects:
        t = h * np.arange(len(y))
        from scipy.interpolate import CubicSpline

        y = CubicSpline(t, y)(np.clip(t + plant.effects["transport_delay"]["tau"], t[0], t[-1]))
    return y


def current_for_displacement(plant: PlainActuator, displacement, h: float, of_reading: bool = False, accelerate: bool = False):
    """The current to apply, A, by the inverse (7), with the secant of M: exact for the implicit Euler model.

    `of_reading`: the trajectory is wanted of the sensor's reading, whose lag and delay are then undone; `accelerate`:
    the operator is inverted by the compiled walk (needs numba; the same numbers). Returns
    (current, infeasible samples, saturated samples). Of the effects, those in `KNOWN_INVERSES` are compensated.
    """
    displacement = np.asarray(displacement, float)
    if not 0 < h < np.inf:
        raise ConfigurationError(f"h = {h} s; give a positive sample time")
    if displacement.ndim != 1 or len(displacement) < 4 or not np.all(np.isfinite(displacement)):
        raise ConfigurationError("the wanted displacement must be one row of four samples or more, all of them numbers, in m")
    wanted, infeasible = feasible_magnetization(plant, undo_sensor(plant, displacement, h) if of_reading else displacement, h)
    operator = plant.operator.copy()
    if accelerate:
        from .accelerated import invert_many

        H, M, saturated, _ = invert_many(operator, wanted)
    else:
        steps = [(operator.solve(float(m)), operator.magnetization, operator.saturated) for m in wanted]
        H, M, saturated = (np.array(column) for column in zip(*steps, strict=True))
    rate = np.concatenate([[0.0], np.diff(H + M)]) / h
    current = rate / plant.c1 + (H - plant.H_bias) / plant.c0
    if "excess_loss" in plant.effects:
        e = plant.effects["excess_loss"]
        flux_rate, knee = MU0 * rate, e["rate_knee"] + 1e-6
        root = 1 / (flux_rate**2 + e["rate_knee"] ** 2 + 1e-12) ** 0.25
        walls = 2 / (knee**0.5 + (knee + 4 * np.abs(flux_rate)) ** 0.5)
        current = current + e["k"] * flux_rate * (root + e.get("full", 0.0) * (walls - root)) / plant.c0
    if "amplifier_lag" in plant.effects:
        lag = plant.effects["amplifier_lag"]
        change = lag["tau"] * np.diff(current, prepend=current[0]) / h
        current = current + change + lag.get("order2", 0.0) * lag["tau"] * np.diff(change, prepend=change[0]) / h
    return current, infeasible, saturated
