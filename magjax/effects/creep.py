"""mechanics: logarithmic creep of mounts and glue, proportional to the displacement."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import power_of_time

LONGEST = 100.0  # s; slower creep is a rest that periodic recordings cannot show
MIDDLE = 0.1  # s, where `gain` is per decade
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)


class Creep(AbstractEffect):
    """Lags spread over the logarithm of time, from `shortest` to 100 s, that add displacement late; evenly at exponent zero.

    How far the mean level has crept depends on how long the drive had run before: `mean_behind`.
    """

    gain: Float[Array, ""] = param(
        0.0, "1", "displacement added per decade of time, at 0.1 s", low=0.0, scale=0.01, null=0.0, typical=(0.001, 0.1)
    )
    shortest: Float[Array, ""] = param(
        1e-3, "s", "time at which the creep begins", low=1e-5, scale=1e-3, shape=True, typical=(1e-4, 1e-1)
    )
    exponent: Float[Array, ""] = power_of_time((0.0, 0.3))
    mean_behind: Float[Array, ""] = param(
        0.0, "1", "decades of creep that the mean level has not taken yet", scale=2.0, shape=True, typical=(0.0, 5.0)
    )

    name = "creep"
    block = "mechanics"
    law = "Y = G U (1 - gain int (tau/0.1 s)^exponent s tau/(1 + s tau) d log10 tau), mean level Y = G U (1 - gain mean_behind)"
    source = (
        "logarithmic creep y ~ 1 + gamma log10 t (K. Kuhnen, H. Janocha, 1998) by its continuous spectrum of lags, "
        "and y ~ t^n (E. N. da C. Andrade, Proc. R. Soc. A 84 (1910) 1)"
    )
    signature = "gain falls by the same amount each decade of frequency, with a small constant lag"
    amplitude = "gain"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with creep, relative to its settled value, m."""

        def decades(s):
            span = jnp.log10(LONGEST / self.shortest)
            tau = self.shortest * 10.0 ** (span * (1 + jnp.asarray(NODES)) / 2)
            share = span * jnp.asarray(WEIGHTS) / 2 * (tau / MIDDLE) ** self.exponent
            lost = share * (s[:, None] * tau) / (1 + s[:, None] * tau)
            return jnp.where(s == 0, -self.mean_behind, -lost.sum(1))

        late = line.filter(displacement, decades)
        return displacement + self.gain * late
