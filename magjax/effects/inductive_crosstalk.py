"""sensor: the changing current couples into the sensor's lines."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class InductiveCrosstalk(AbstractEffect):
    """A reading proportional to dI/dt; in detail it comes late, by the shield or the sensor's electronics."""

    kappa: Float[Array, ""] = param(0.0, "m s/A", "reading per rate of the current", scale=1e-10, null=0.0, typical=(-1e-8, 1e-8))

    tau: Float[Array, ""] = param(
        0.0, "s", "lag of what is picked up", low=0.0, scale=5e-5, shape=True, detail=True, typical=(0.0, 1e-3)
    )

    name = "inductive_crosstalk"
    block = "sensor"
    law = "reading = y + kappa d/dt I / (1 + tau s)"
    source = "mutual inductance between drive leads and sensor leads"
    signature = "in quadrature with the current, growing with frequency, at the drive's own lines only"
    amplitude = "kappa"
    magnetic = True

    def reading(self, reading, signals, line, actuator):
        """Reading with crosstalk."""
        rate = line.derivative(signals["current"])
        return reading + self.kappa * (rate - line.filter(rate, lambda s: s * self.tau / (1 + s * self.tau)))
