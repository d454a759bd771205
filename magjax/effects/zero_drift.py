"""sensor: its zero wanders with time."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class ZeroDrift(AbstractEffect):
    """A linear drift of the zero through the record."""

    rate: Float[Array, ""] = param(0.0, "m/s", "drift of the zero", scale=1e-8, null=0.0, typical=(-1e-5, 1e-5))

    name = "zero_drift"
    block = "sensor"
    law = "reading = y + rate t"
    source = "warm-up of sensor electronics"
    signature = "a ramp through every record, whatever the drive: at one rate, or of each record by itself, bent as warming up is; or another level in each"
    amplitude = "rate"
    record_level = True

    def reading(self, reading, signals, line, actuator):
        """Reading with the ramp."""
        return reading + self.rate * line.time
