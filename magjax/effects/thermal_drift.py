"""mechanics: Joule heat of the coil warms rod and housing, which expand."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class ThermalDrift(AbstractEffect):
    """Expansion behind the heat I^2 R by one thermal time constant, from cold at the start of the record.

    The heat pulses with the square of the current: beside the slow drift the rod breathes at twice the drive's frequency, by
    rate I^2 / (8 pi f) for a sine of amplitude I.
    """

    rate: Float[Array, ""] = param(
        0.0, "m/(A^2 s)", "expansion rate per squared current", scale=1e-7, null=0.0, typical=(1e-9, 1e-4)
    )
    tau: Float[Array, ""] = param(30.0, "s", "thermal time constant", low=0.0, scale=30.0, shape=True, typical=(0.05, 600.0))

    name = "thermal_drift"
    block = "mechanics"
    law = "y -> y + rate theta, d theta/dt = I^2 - theta/tau, theta(0) = 0"
    source = "one-node thermal model of a coil on a rod; what drifts within the records is fitted with the times of two nodes where those serve better"
    signature = "a drift that grows with the squared current; a ripple at twice the frequency that falls as 1/f; a zero of each recording, by how warm it began"
    amplitude = "rate"
    magnetic = True
    record_level = True

    def reading(self, reading, signals, line, actuator):
        """Reading with the expansion over the record's time; the square of the current runs straight between samples."""
        heat, kept = signals["current"] ** 2, jnp.exp(-line.dt / self.tau)
        steps = self.tau * (1 - kept) * (heat[1:] + heat[:-1]) / 2

        def warm(theta, step):
            theta = kept * theta + step
            return theta, theta

        _, theta = jax.lax.scan(warm, jnp.zeros(()), steps)
        return reading + self.rate * jnp.concatenate([jnp.zeros(1), theta])
