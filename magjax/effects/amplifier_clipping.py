"""source: voltage compliance bounds the slope of the current, |dI/dt| <= 1/slope_time * range."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class AmplifierClipping(AbstractEffect):
    """A power supply of limited voltage flattens the current's extremes: a smooth odd saturation of the current's swing.

    With coil voltage V = R I + L dI/dt + N A dB/dt bounded by V_max, what is left of a sine is compressed where
    V is largest. Law here: I - c (V/V_ref)^2 V / R with V from R and L of the coil, V_ref = 1 V per ohm and ampere.
    """

    compression: Float[Array, ""] = param(0.0, "1/A^2", "cubic compression of the current by the coil voltage", low=0.0, scale=1e-2, null=0.0, typical=(1e-3, 0.3))
    tau_L: Float[Array, ""] = param(1e-3, "s", "L/R of coil and leads", low=0.0, scale=1e-3, shape=True)

    name = "amplifier_clipping"
    block = "source"
    law = "I = command - c v^3, v = command + tau_L d command/dt (coil voltage over R)"
    source = "voltage compliance |L dI/dt + R I + N A dB/dt| <= V_max, smooth cubic onset"
    signature = "odd harmonics of the drive that grow with amplitude and, through tau_L, with frequency"
    amplitude = "compression"

    def drive(self, current, line, actuator):
        """Current less its cubic compression."""
        voltage = (current - jnp.mean(current)) + self.tau_L * line.derivative(current)
        return current - self.compression * voltage**3
