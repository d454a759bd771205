"""mechanics: logarithmic creep of mounts and glue, proportional to the displacement."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

LONGEST = 100.0  # s; slower creep is a rest that periodic recordings cannot show


class Creep(AbstractEffect):
    """Lags spread evenly over the logarithm of time, from `shortest` to 100 s, that add displacement late.

    How far the mean level has crept depends on how long the drive had run before: `mean_behind`.
    """

    gain: Float[Array, ""] = param(
        0.0, "1", "displacement added per decade of time", low=0.0, scale=0.01, null=0.0, typical=(0.001, 0.1)
    )
    shortest: Float[Array, ""] = param(
        1e-3, "s", "time at which the creep begins", low=1e-5, scale=1e-3, shape=True, typical=(1e-4, 1e-1)
    )
    mean_behind: Float[Array, ""] = param(
        0.0, "1", "decades of creep that the mean level has not taken yet", scale=2.0, shape=True, typical=(0.0, 5.0)
    )

    name = "creep"
    block = "mechanics"
    law = "Y = G U (1 + gain log10((1 + s shortest)/(1 + s 100 s))), mean level Y = G U (1 - gain mean_behind)"
    source = "logarithmic creep y ~ 1 + gamma log10 t (K. Kuhnen, H. Janocha, 1998), by its continuous spectrum of lags"
    signature = "gain falls by the same amount each decade of frequency, with a small constant lag"
    amplitude = "gain"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with creep, relative to its settled value, m."""

        def decades(s):
            return jnp.where(s == 0, -self.mean_behind, jnp.log((1 + s * self.shortest) / (1 + s * LONGEST)) / jnp.log(10.0))

        late = line.filter(displacement, decades)
        return displacement + self.gain * late
