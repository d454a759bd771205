"""mechanics: logarithmic creep of mounts and glue, proportional to the displacement."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

TIMES = (1e-2, 1e-1, 1.0, 10.0)


class Creep(AbstractEffect):
    """A ladder of lags, one a decade, that adds displacement late."""

    gain: Float[Array, ""] = param(0.0, "1", "displacement added per decade of time", low=0.0, scale=0.01, null=0.0, typical=(0.001, 0.1))

    name = "creep"
    block = "mechanics"
    law = "Y = G U (1 + gain sum_i (1/(1 + s tau_i) - 1)), tau = 10 ms .. 10 s"
    source = "logarithmic creep y ~ 1 + gamma log10 t (K. Kuhnen, H. Janocha, 1998)"
    signature = "gain falls by the same amount each decade of frequency, with a small constant lag"
    amplitude = "gain"

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with creep, relative to its settled value, m."""
        return displacement + self.gain * line.filter(displacement, lambda s: sum(1 / (1 + s * t) - 1 for t in TIMES))
