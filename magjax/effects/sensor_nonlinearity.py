"""sensor: its characteristic is not straight."""

import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class SensorNonlinearity(AbstractEffect):
    """Departure from a straight line over the range of the sensor, of second to sixth order."""

    q2: Float[Array, ""] = param(0.0, "1", "quadratic departure at full range", scale=0.01, null=0.0, typical=(-0.1, 0.1))
    c3: Float[Array, ""] = param(
        0.0, "1", "cubic departure relative to the quadratic one", scale=1.0, shape=True, typical=(-3.0, 3.0)
    )
    c4: Float[Array, ""] = param(
        0.0, "1", "departure of fourth order relative to the quadratic one", scale=1.0, shape=True, typical=(-3.0, 3.0)
    )
    c5: Float[Array, ""] = param(
        0.0, "1", "departure of fifth order relative to the quadratic one", scale=1.0, shape=True, typical=(-3.0, 3.0)
    )
    c6: Float[Array, ""] = param(
        0.0, "1", "departure of sixth order relative to the quadratic one", scale=1.0, shape=True, typical=(-3.0, 3.0)
    )
    c0: Float[Array, ""] = param(
        0.0, "1", "departure at zero relative to the quadratic one", scale=0.2, shape=True, typical=(-1.0, 1.0)
    )

    name = "sensor_nonlinearity"
    block = "sensor"
    law = "reading = y + l q2 (c0 + r^2 (1 + c3 r + c4 r^2 + c5 r^3 + c6 r^4)), r = y/l, l = saturation displacement"
    source = "linearity error of LVDTs, as in their data sheets"
    signature = "distortion that is a function of y alone at every frequency; a free density absorbs it at low frequency"
    amplitude = "q2"

    def extent(self, readings, actuator) -> float:
        """Largest departure relative to the largest motion, over the motion that makes the readings: a polynomial may run far
        outside it."""
        largest, departures, motions = max(np.max(np.abs(readings)), 1e-300), [0.0], [1e-3 * np.ptp(readings)]
        for side in (-1.0, 1.0):
            y = side * largest * np.linspace(0, 2, 401)
            read = np.asarray(self.reading(y, None, None, actuator))
            low, high = min(readings[0], read[0]), max(readings[1], read[0])
            led = np.cumprod((read >= low) & (read <= high) & (side * (read - read[0]) >= 0)).astype(bool)
            seen = led & (read >= readings[0]) & (read <= readings[1])
            departures.extend(np.abs(read - y)[seen])
            motions.extend(np.abs(y)[seen])
        return float(max(departures) / max(motions))

    def reading(self, reading, signals, line, actuator):
        """Reading through the curve."""
        reach = actuator.strained.reach if actuator.strained is not None else 1.0
        part = reading / reach
        curve = part * part * (1 + part * (self.c3 + part * (self.c4 + part * (self.c5 + part * self.c6))))
        return reading + reach * self.q2 * (self.c0 + curve)
