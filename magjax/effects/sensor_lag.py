"""sensor: a filter of first or second order in the sensor's electronics."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class SensorLag(AbstractEffect):
    """Low-pass 1/(1 + s tau + order2 (s tau)^2): first order for order2 = 0, Butterworth for 1/2."""

    tau: Float[Array, ""] = param(
        0.0, "s", "delay of the filter at low frequency", low=0.0, scale=1e-5, null=0.0, typical=(5e-6, 1e-3)
    )
    order2: Float[Array, ""] = param(0.25, "1", "second-order share", low=0.0, scale=0.25, shape=True, typical=(0.0, 0.6))

    name = "sensor_lag"
    block = "sensor"
    law = "reading = y / (1 + s tau + order2 (s tau)^2)"
    source = "anti-alias and demodulation filters of LVDT conditioners (first or second order)"
    signature = "a lag of y alone, at every harmonic by its own frequency"
    amplitude = "tau"

    def reading(self, reading, signals, line, actuator):
        """Filtered reading."""

        def change(s):
            late = s * self.tau + self.order2 * (s * self.tau) ** 2
            return -late / (1 + late)

        return reading + line.filter(reading, change)
