"""sensor: a pure delay between displacement and its sample."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class TransportDelay(AbstractEffect):
    """The reading comes `tau` late (sampling skew between channels, digital filters)."""

    tau: Float[Array, ""] = param(0.0, "s", "delay", scale=1e-5, null=0.0, typical=(-1e-4, 1e-3))

    name = "transport_delay"
    block = "sensor"
    law = "reading(t) = y(t - tau)"
    source = "channel skew of multiplexed converters"
    signature = "phase linear in frequency with no change of gain"
    amplitude = "tau"

    def reading(self, reading, signals, line, actuator):
        """Delayed reading."""
        return reading + line.filter(reading, lambda s: jnp.exp(-s * self.tau) - 1)
