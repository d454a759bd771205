"""hysteresis: the relays see H + alpha M (Weiss field; a demagnetising factor has the other sign)."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class MeanField(AbstractEffect):
    """Moving Preisach model: the effective field of the relays is H + alpha M."""

    alpha: Float[Array, ""] = param(0.0, "1", "mean-field coefficient", scale=1e-3, null=0.0, typical=(-5e-3, 1e-2))

    name = "mean_field"
    block = "hysteresis"
    law = "M = Gamma[H + alpha M]"
    source = "E. Della Torre, IEEE Trans. Audio Electroacoust. 14 (1966) 86 (moving model)"
    signature = "loops lean over or stand up with M; a free density absorbs it from these channels"
    amplitude = "alpha"
    in_step = True

    def field_shift(self, trial, state, actuator):
        """H less the relays' field, A/m."""
        return -self.alpha * trial.magnetization
