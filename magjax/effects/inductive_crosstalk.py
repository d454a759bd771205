"""sensor: the changing current couples into the sensor's lines."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class InductiveCrosstalk(AbstractEffect):
    """A reading proportional to dI/dt."""

    kappa: Float[Array, ""] = param(0.0, "m s/A", "reading per rate of the current", scale=1e-10, null=0.0, typical=(-1e-8, 1e-8))

    name = "inductive_crosstalk"
    block = "sensor"
    law = "reading = y + kappa dI/dt"
    source = "mutual inductance between drive leads and sensor leads"
    signature = "in quadrature with the current, growing with frequency, at the drive's own lines only"
    amplitude = "kappa"
    magnetic = True

    def reading(self, reading, signals, line, actuator):
        """Reading with crosstalk."""
        return reading + self.kappa * line.derivative(signals["current"])
