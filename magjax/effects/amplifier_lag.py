"""source: the amplifier follows its command late, with a lag of first or second order."""

from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect


class AmplifierLag(AbstractEffect):
    """Command to current: 1/(1 + s tau + order2 (s tau)^2); two equal poles for order2 = 1/4, Butterworth for 1/2."""

    tau: Float[Array, ""] = param(
        0.0, "s", "lag of the amplifier at low frequency", low=0.0, scale=1e-5, null=0.0, typical=(5e-6, 5e-4)
    )
    order2: Float[Array, ""] = param(0.0, "1", "second-order share", low=0.0, scale=0.25, shape=True, typical=(0.0, 0.6))

    name = "amplifier_lag"
    block = "source"
    law = "I = command / (1 + s tau + order2 (s tau)^2)"
    source = "bandwidth of a linear amplifier in current mode (Kepco BOP manual); a current loop round the coil is of second order"
    signature = "the whole loop turns with frequency by a lag that grows as 2 pi f tau, in the field as well as in the reading"
    amplitude = "tau"

    def drive(self, current, line, actuator):
        """Delayed current; exact identity at tau = 0."""

        def late(s):
            lag = s * self.tau + self.order2 * (s * self.tau) ** 2
            return lag / (1 + lag)

        return current - line.filter(current, late)
