"""sensor: hum of the mains."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class MainsHum(AbstractEffect):
    """A sine at the mains frequency, with a phase of its own in each record (zero here)."""

    amplitude_m: Float[Array, ""] = param(0.0, "m", "amplitude of the hum", scale=1e-8, null=0.0, typical=(1e-9, 1e-6))
    f: Float[Array, ""] = param(50.0, "Hz", "mains frequency", low=0.0, scale=50.0, shape=True, typical=(50.0, 60.0))

    name = "mains_hum"
    block = "sensor"
    law = "reading = y + a sin(2 pi f t + phase of the record)"
    source = "50 or 60 Hz and harmonics from ground loops"
    signature = "lines at the mains frequency whatever the drive: between the harmonics of most recordings"
    amplitude = "amplitude_m"
    record_level = True

    def reading(self, reading, signals, line, actuator):
        """Reading with hum."""
        return reading + self.amplitude_m * jnp.sin(2 * jnp.pi * self.f * line.time)
