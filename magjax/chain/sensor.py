"""Sensor: displacement y or flux density B -> reading, same unit: an ideal sensor with an offset.

Left out: its filter (sensor_lag, transport_delay), its curve (sensor_nonlinearity), crosstalk, hum and drift.
"""

import equinox as eqx
from jaxtyping import Array, Float

from ..param import param


class Sensor(eqx.Module):
    """A sensor that reads the quantity plus an offset."""

    offset: Float[Array, ""] = param(0.0, "reading", "zero of the sensor", scale=1e-5, typical=(-1e-4, 1e-4))

    def __call__(self, quantity):
        """The reading."""
        return quantity + self.offset
