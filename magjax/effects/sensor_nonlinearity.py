"""sensor: its characteristic is not straight."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

STRAIGHT_BEYOND = 1.1  # half ranges from the middle, beyond which the curve goes on along its tangent: a polynomial would run off
OVER_RANGE = STRAIGHT_BEYOND * np.linspace(-1, 1, 201)


class SensorNonlinearity(AbstractEffect):
    """Departure from the best straight line over a range of the sensor: Legendre polynomials of second to sixth order.

    These have no slope and no mean over the range. A curve that had some would be a gain, which no density tells from a larger
    magnetization, and the fit would wander along it. On a rough density much of any curve is such, which the prior on q tells.
    """

    q: Float[Array, ""] = param(
        0.0,
        "1",
        "departure of second and third order, relative to half the range",
        scale=0.01,
        null=0.0,
        prior=0.02,
        typical=(-0.1, 0.1),
    )
    mix: Float[Array, ""] = param(
        0.0, "rad", "of these two: second order alone at 0, third alone at pi/2", scale=1.0, shape=True, typical=(-1.6, 1.6)
    )
    c4: Float[Array, ""] = param(0.0, "1", "departure of fourth order relative to q", scale=1.0, shape=True, typical=(-3.0, 3.0))
    c5: Float[Array, ""] = param(0.0, "1", "departure of fifth order relative to q", scale=1.0, shape=True, typical=(-3.0, 3.0))
    c6: Float[Array, ""] = param(0.0, "1", "departure of sixth order relative to q", scale=1.0, shape=True, typical=(-3.0, 3.0))
    c0: Float[Array, ""] = param(0.0, "1", "mean departure relative to q", scale=1.0, shape=True, typical=(-3.0, 3.0))
    centre: Float[Array, ""] = param(0.0, "m", "middle of the range, where `half` is not 0", scale=1e-5, shape=True, given=True)
    half: Float[Array, ""] = param(
        0.0,
        "m",
        "half of the range; 0: from 0 to the saturation displacement, of a flux density -1 .. 1 T",
        low=0.0,
        scale=1e-5,
        shape=True,
        given=True,
    )

    name = "sensor_nonlinearity"
    block = "sensor"
    law = (
        "reading = y + half q (c0 + cos(mix) P2(u) + sin(mix) P3(u) + c4 P4(u) + c5 P5(u) + c6 P6(u)), u = (y - centre) / half + q c0, "
        "along the tangent where |u| > 1.1"
    )
    source = "linearity error of LVDTs, as in their data sheets: from the best straight line over the range"
    signature = "distortion that is a function of y alone at every frequency; a free density absorbs it at low frequency"
    amplitude = "q"

    @classmethod
    def seen_in(cls, readings) -> dict:
        """The range that the line was laid through: that of the readings, m."""
        return {"centre": 0.5 * (readings[0] + readings[1]), "half": 0.5 * (readings[1] - readings[0])}

    def is_itself(self) -> bool:
        """Whether the reading rises with the motion over the range and beyond: a curve that turns stands for a density."""
        return bool(np.all(1 + float(self.q) * np.asarray(self._curve(OVER_RANGE)[1]) > 0))

    def reading(self, reading, signals, line, actuator):
        """Reading through the curve."""
        half, centre = (0.5 * actuator.strained.reach,) * 2 if actuator.strained is not None else (1.0, 0.0)
        half, centre = jnp.where(self.half > 0, self.half, half), jnp.where(self.half > 0, self.centre, centre)
        offset = self.q * self.c0
        u = (reading - centre) / half + offset
        near = jnp.clip(u, -STRAIGHT_BEYOND, STRAIGHT_BEYOND)
        value, slope = self._curve(near)
        return reading + half * (offset + self.q * (value + slope * (u - near)))

    def _curve(self, u):
        """The sum of the polynomials and its slope, by their recursion."""
        weights = (0.0, jnp.cos(self.mix), jnp.sin(self.mix), self.c4, self.c5, self.c6)  # of the first order on
        before, now, slopes = jnp.ones_like(u), u, (jnp.zeros_like(u), jnp.ones_like(u))
        value, slope = jnp.zeros_like(u), jnp.zeros_like(u)
        for n, weight in enumerate(weights, start=1):
            value, slope = value + weight * now, slope + weight * slopes[1]
            following = ((2 * n + 1) * u * now - n * before) / (n + 1)
            slopes = slopes[1], slopes[0] + (2 * n + 1) * now
            before, now = now, following
        return value, slope
