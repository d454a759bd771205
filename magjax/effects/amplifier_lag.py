"""source: the amplifier follows its command with a first-order lag, tau dI/dt + I = command."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class AmplifierLag(AbstractEffect):
    """First-order lag of a current amplifier; the current is then the command filtered by 1/(1 + s tau)."""

    tau: Float[Array, ""] = param(0.0, "s", "time constant of the amplifier", low=0.0, scale=1e-5, null=0.0, typical=(5e-6, 5e-4))

    name = "amplifier_lag"
    block = "source"
    law = "tau dI/dt + I = command"
    source = "first-order model of a linear amplifier's bandwidth (Kepco BOP manual: current-mode bandwidth)"
    signature = "the whole loop turns with frequency by a lag that grows as 2 pi f tau, in the field as well as in the reading"
    amplitude = "tau"

    def drive(self, current, line, actuator):
        """I = command - s tau/(1 + s tau) command: exact identity at tau = 0."""
        return current - line.filter(current, lambda s: s * self.tau / (1 + s * self.tau))
