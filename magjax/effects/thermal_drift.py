"""mechanics: Joule heat of the coil warms rod and housing, which expand."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class ThermalDrift(AbstractEffect):
    """Expansion behind the heat I^2 R by one thermal time constant, from cold at the start of the record."""

    rate: Float[Array, ""] = param(
        0.0, "m/(A^2 s)", "expansion rate per squared current", scale=1e-7, null=0.0, typical=(1e-9, 1e-4)
    )
    tau: Float[Array, ""] = param(30.0, "s", "thermal time constant", low=0.0, scale=30.0, shape=True, typical=(0.05, 600.0))

    name = "thermal_drift"
    block = "mechanics"
    law = "y -> y + rate I_rms^2 tau (1 - exp(-t/tau))"
    source = "one-node thermal model of a coil on a rod"
    signature = "a drift through the record that grows with the squared current; it lives between the harmonics"
    amplitude = "rate"
    magnetic = True
    record_level = True

    def reading(self, reading, signals, line, actuator):
        """Reading with the drift over the record's time."""
        heat = jnp.mean(signals["current"] ** 2)
        return reading + self.rate * heat * self.tau * (1 - jnp.exp(-line.time / self.tau))
