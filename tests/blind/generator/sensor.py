"""What stands between the rod and the reading, on one settled period; and what runs beside the drive, on the whole record."""

import numpy as np

from .rod import response
from .strain import FULL, settled_play


def amplifier(command, frequency, effects):
    """Coil current from the command, A: a second-order lag of the stated delay, a voltage limit, an eddy path in the housing."""
    current = command
    if "amplifier_lag" in effects:
        half = effects["amplifier_lag"] / 2
        current = response(current, frequency, lambda s: 1 / (1 + half * s) ** 2)
    if "amplifier_clipping" in effects:  # compliance: L dI/dt + R I stays within a window
        steps, inductance, resistance = current.shape[1], 5e-3, 6.0
        h = 1 / (frequency * steps)
        volt = effects["amplifier_clipping"]
        I, out = current[:, 0].copy(), np.empty_like(current)
        for _turn in range(3):
            for n in range(steps):
                L = inductance / h
                I = np.clip(current[:, n], (L * I - volt) / (L + resistance), (L * I + volt) / (L + resistance))
                out[:, n] = I
        current = out
    return current


def sleeve(current, frequency, effects):
    """Magnetising current left by a shorted housing, tau dI2/dt + I2 = kappa tau dI/dt."""
    tau, kappa = 2e-3, effects.get("second_eddy_path", 0.0)
    return response(current, frequency, lambda s: 1 - kappa * tau * s / (1 + tau * s)) if kappa else current


def reading(y, current, frequency, effects):
    """The sensor's output over one settled period, m."""
    if "backlash" in effects:
        y = settled_play(y, effects["backlash"])
    if "sensor_lag" in effects:  # Bessel, second order, of the stated delay
        tau = effects["sensor_lag"]
        y = response(y, frequency, lambda s: 3 / (3 + 3 * tau * s + (tau * s) ** 2))
    if "transport_delay" in effects:
        y = response(y, frequency, lambda s: np.exp(-s * effects["transport_delay"]))
    if "sensor_nonlinearity" in effects:  # an LVDT's even and odd curvature
        x = y / FULL - 0.25
        y = y + effects["sensor_nonlinearity"] * FULL * (np.sin(3 * x) / 3 - x + 0.8 * x**2)
    if "cyclic_error" in effects:  # in no catalogue: an interferometer's fringe error
        y = y + effects["cyclic_error"] * np.sin(4 * np.pi * y / 3.2e-6)
    if "inductive_crosstalk" in effects:
        y = y + effects["inductive_crosstalk"] * response(current, frequency, lambda s: s / (1 + s / (2 * np.pi * 8e3)))
    return y


def beside(time, heat, effects, rng):
    """What adds to the reading over the record's own `time` (samples,), s; `heat` is the mean square current, A^2."""
    out = np.zeros_like(time)
    length = time[-1] - time[0]
    if "zero_drift" in effects:  # not straight: a root and a wander
        wander = np.cumsum(rng.normal(size=len(time))) / np.sqrt(len(time))
        out += effects["zero_drift"] * (np.sqrt(time / length) + 0.15 * wander)
    if "thermal_drift" in effects:  # two nodes: winding and rod
        out += effects["thermal_drift"] * heat / 0.3 * (1 - 0.6 * np.exp(-time / 0.8) - 0.4 * np.exp(-time / 6.0))
    if "mains_hum" in effects:
        phase, mains = rng.uniform(0, 2 * np.pi, 3), 50.0 + rng.normal() * 0.01
        out += effects["mains_hum"] * sum(
            a * np.sin(2 * np.pi * k * mains * time + p) for a, k, p in zip((1, 0.3, 0.2), (1, 2, 3), phase, strict=True)
        )
    return out
