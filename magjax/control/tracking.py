"""Tracking studies, T&B Figs. 10 and 16-19: what feedback, inversion and l1 control make of a wanted displacement.

Every plant is integrated event by event under the held current; controllers and inverses know only their model.
"""

import dataclasses

import numpy as np

from ..errors import ConfigurationError
from ..inverse.dynamic import PlainActuator, current_for_displacement, magnetization_for
from ..inverse.events import HeldCurrent
from .l1 import TrackingProblem, design
from .problem import rod
from .realize import reduced_controller

STRATEGIES = ("proportional", "static_inverse", "dynamic_inverse", "l1", "l1_over_relaxed")
MIDDLE = 0.5  # M_s^2: the control acts about half of the range, u_b of T&B Sec. 4.2


@dataclasses.dataclass(frozen=True)
class Track:
    """One run: `time` (s), `wanted`, `reached` (m), `current` (A), `saturated`: share of samples at a
    limit of the amplifier or of the control, or whose displacement is out of reach."""

    strategy: str
    time: np.ndarray
    wanted: np.ndarray
    reached: np.ndarray
    current: np.ndarray
    saturated: float

    def errors(self, skip: float = 0.25) -> tuple[float, float]:
        """(rms, largest) tracking error after the first `skip` of the run, m."""
        e = (self.reached - self.wanted)[int(skip * len(self.time)) :]
        return float(np.sqrt(np.mean(e**2))), float(np.abs(e).max())


def _samples(duration, T, highest):
    if not 0 < T <= 1 / (8 * highest):
        raise ConfigurationError(
            f"T = {T} s: a trajectory with tones up to {highest:.3g} Hz needs a sample time of at most {1 / (8 * highest):.3g} s"
        )
    return T * np.arange(int(round(duration / T)))


def sinusoid(plant: PlainActuator, T: float, frequency: float = 20.0, periods: int = 8, share: float = 0.22):
    """A sinusoid about the middle of the range: (time, displacement)."""
    t = _samples(periods / frequency, T, frequency)
    stroke = plant.l_rod * plant.lambda_s
    return t, stroke * (MIDDLE + share * np.sin(2 * np.pi * frequency * t) * np.minimum(1.0, t * frequency))


def aperiodic(plant: PlainActuator, T: float, duration: float = 0.4, share: float = 0.2):
    """An aperiodic trajectory round 30 Hz: three tones that never close."""
    t = _samples(duration, T, 40.0)
    tones = (
        np.sin(2 * np.pi * 29.0 * t)
        + 0.6 * np.sin(2 * np.pi * 19.0 * np.sqrt(2) * t + 1)
        + 0.4 * np.sin(2 * np.pi * 14.0 * np.e * t + 2)
    )
    return t, plant.l_rod * plant.lambda_s * (MIDDLE + share / 2 * tones * np.minimum(1.0, 20 * t))


def track(
    plant: PlainActuator,
    model: PlainActuator,
    time,
    wanted,
    strategy: str,
    u_bar: float = 3.25,
    limit: float = 2.0,
    noise: float = 0.0,
) -> Track:
    """Run one strategy. `plant`: what is driven; `model`: what the controller believes; `limit`: of the current, A;
    `noise`: of the reading that feedback sees, m rms (the same draw in every run)."""
    if strategy not in STRATEGIES:
        raise ConfigurationError(f'strategy "{strategy}" is unknown; there are {", ".join(STRATEGIES)}')
    if strategy == "proportional":
        # the gain that does best on the plant itself: what careful tuning finds (Sec. 3.2); tuned on a model it may be unstable
        gains = np.geomspace(2e3, 2e5, 13)
        heard = noise * np.random.default_rng(7).standard_normal(len(time))
        errors = [_feedback(plant, model, time, wanted, g, limit, heard).errors()[0] for g in gains]
        return _feedback(plant, model, time, wanted, float(gains[int(np.argmin(errors))]), limit, heard)
    if strategy.startswith("l1"):
        heard = noise * np.random.default_rng(7).standard_normal(len(time))
        return _robust(plant, model, time, wanted, u_bar if strategy == "l1" else 5.0, limit, strategy, heard)
    current, wrong = held_mean(model, time, wanted, static=strategy == "static_inverse")
    return _open_loop(plant, time, wanted, current, wrong, limit, strategy)


def held_mean(model: PlainActuator, time, wanted, static: bool = False, finer: int = 16):
    """The inverse of a wanted displacement (m), averaged over each hold, A: as good as a held current can be to second order.

    Computed on a grid `finer` times finer than the samples. `static`: of the Preisach operator alone, without (4) and (5).
    Returns (current, which holds contain a displacement that is out of reach and was replaced by the nearest).
    """
    from scipy.interpolate import CubicSpline

    T = time[1] - time[0]
    fine = time[0] + T / finer * np.arange(finer * len(time) + 1)
    path = CubicSpline(time, wanted)(fine)  # led on over the last hold
    if static:
        operator, strain = model.operator.copy(), path / (model.l_rod * model.lambda_s)
        current = (operator.invert(magnetization_for(model, strain)) - model.H_bias) / model.c0
        wrong = (strain < 0) | (strain > 1)
    else:
        current, infeasible, saturated = current_for_displacement(model, path, T / finer)
        wrong = infeasible | saturated
    return current[1:].reshape(len(time), finer).mean(axis=1), wrong[1:].reshape(len(time), finer).any(axis=1)


def _open_loop(plant, time, wanted, current, wrong, limit, strategy):
    T = time[1] - time[0]
    clipped = np.clip(current, -limit, limit)
    actuator = _start(plant, clipped[0])
    reached = np.empty(len(time))
    for k, I in enumerate(clipped):
        reached[k] = actuator.displacement
        actuator.hold(float(I), T)
    return Track(strategy, time, wanted, reached, clipped, float(np.mean((clipped != current) | wrong)))


def _start(plant, current):
    return HeldCurrent(plant, float(current))


def _feedback(plant, model, time, wanted, gain, limit, heard):
    """Current proportional to the error, A/m, about the current that holds the middle of the model."""
    T = time[1] - time[0]
    middle = _holding_current(model)
    actuator = _start(plant, middle)
    reached, current = np.empty(len(time)), np.empty(len(time))
    saturated = 0
    for k in range(len(time)):
        reached[k] = actuator.displacement
        asked = middle + gain * (wanted[k] - reached[k] - heard[k])
        current[k] = min(max(asked, -limit), limit)
        saturated += current[k] != asked
        actuator.hold(current[k], T)
    return Track("proportional", time, wanted, reached, current, saturated / len(time))


def _holding_current(model):
    operator = model.operator.copy()
    return (operator.solve(float(magnetization_for(model, MIDDLE))) - model.H_bias) / model.c0


def _robust(plant, model, time, wanted, u_bar, limit, strategy, heard):
    """K on the tracking error, its control inverted by (7): u_c in units of M_s^2 about the middle.

    The reference is given two samples ahead, the delays that e_t[k] = y_ref[k-2] - y[k] of Sec. 4.2 allows for.
    """
    T = float(time[1] - time[0])
    stroke = 1e6 * model.l_rod * model.lambda_s
    problem = TrackingProblem(plant=rod(model.f0, model.xi, T, stroke), u_bar=u_bar, T=T)
    controller = reduced_controller(design(problem))
    controller.reset()
    inverse = model.operator.copy()
    H, M = inverse.solve(float(magnetization_for(model, MIDDLE))), inverse.magnetization
    actuator = _start(plant, (H - model.H_bias) / model.c0)
    reached, current, saturated = np.empty(len(time)), np.empty(len(time)), 0
    lag = model.effects.get("amplifier_lag", {}).get("tau", 0.0)
    last = None
    for k in range(len(time)):
        reached[k] = actuator.displacement
        error = 1e6 * (wanted[min(k + 2, len(time) - 1)] - reached[k] - heard[k])
        u = controller.step(error, MIDDLE, anti_windup=strategy == "l1")
        saturated += abs(u) >= MIDDLE
        H1 = inverse.solve(float(magnetization_for(model, MIDDLE + u)))
        M1 = inverse.magnetization
        I = (H1 + M1 - H - M) / (T * model.c1) + (H1 - model.H_bias) / model.c0
        H, M = H1, M1
        asked = I if last is None or lag == 0 else I + lag * (I - last) / T
        last = I
        current[k] = min(max(asked, -limit), limit)
        actuator.hold(current[k], T)
    return Track(strategy, time, wanted, reached, current, saturated / len(time))


def perturbed(plant: PlainActuator, share: float = 0.05, seed: int = 0) -> PlainActuator:
    """A model with the errors of a fit: masses off by `share` (relative, independent), R_eddy, xi and f0 by a third of it."""
    from ..inverse.bounds import _masses
    from ..inverse.operator import PlainPreisach

    rng = np.random.default_rng(seed)
    masses = _masses(plant)
    masses = np.maximum(masses * (1 + share * rng.standard_normal(masses.shape)), 0.0)
    operator = PlainPreisach(masses, plant.operator.low, plant.operator.high, plant.operator.offset)
    third = share / 3
    signs = rng.choice([-1.0, 1.0], 3)
    return dataclasses.replace(
        plant,
        operator=operator,
        R_eddy=plant.R_eddy * (1 + third * signs[0]),
        xi=plant.xi * (1 + third * signs[1]),
        f0=plant.f0 * (1 + third * signs[2]),
    )


def compare(plants: dict, T: float = 5e-4, strategies=STRATEGIES) -> list[dict]:
    """Every strategy on every pair name -> (plant, model) or (plant, model, noise of the reading, m), for the sinusoid and
    the aperiodic trajectory: rows of a table."""
    rows = []
    for name, (plant, model, *noise) in plants.items():
        for shape, make in (("20 Hz sine", sinusoid), ("aperiodic, 30 Hz", aperiodic)):
            time, wanted = make(plant, T)
            for strategy in strategies:
                run = track(plant, model, time, wanted, strategy, noise=noise[0] if noise else 0.0)
                rms, largest = run.errors()
                rows.append(
                    {
                        "plant": name,
                        "trajectory": shape,
                        "strategy": strategy,
                        "rms_m": rms,
                        "largest_m": largest,
                        "saturated": run.saturated,
                    }
                )
    return rows
