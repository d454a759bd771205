"""magnetostriction: the strain lags behind M^2 on its own, rate-independently."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

PLAYS = (0.1, 0.3, 0.6, 1.0)  # half-widths relative to the widest


class StrainHysteresis(AbstractEffect):
    """A few play operators on the free displacement u or, `of_m`, on the magnetization, what they lag then added to u as it is.

    A lag of M itself, in its square, would be one of the hysteresis: it is what the density does.
    """

    share: Float[Array, ""] = param(0.0, "1", "share of the strain that lags", scale=0.1, null=0.0, typical=(0.01, 0.5))

    width: Float[Array, ""] = param(
        0.1, "1", "half-width of the widest play relative to saturation", low=0.0, scale=0.1, shape=True, typical=(0.01, 0.3)
    )
    of_m: Float[Array, ""] = param(
        0.0, "1", "0: the lag is along the path of the strain, 1: of M", low=0.0, high=1.0, scale=0.5, shape=True, typical=(0.0, 1.0)
    )

    name = "strain_hysteresis"
    block = "magnetostriction"
    law = (
        "u -> u + h [(1 - of_m) mean_i(play_ri(u) - u) + of_m u_s mean_i(play_ri(m) - m)], m = M/M_s, u_s = lambda_s l_rod, "
        "r = 10, 30, 60, 100 % of the width (times u_s for u)"
    )
    source = (
        "hysteresis of lambda against M^2 in Terfenol-D (M. Moffett et al., J. Acoust. Soc. Am. 89 (1991) 1448); "
        "along M, as a Bouc-Wen or Jiles-Atherton law of the domains' strain has it"
    )
    signature = "a lag of y that does not depend on frequency and is absent in M"
    amplitude = "share"

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with plays, m."""
        rod = actuator.magnetostriction
        widths = jnp.asarray(PLAYS) * jnp.maximum(self.width, 0.0)
        signals = jnp.stack([free_displacement / rod.reach, magnetization / rod.M_s], axis=1)

        def follow(state, now):
            state = jnp.clip(state, now[:, None] - widths, now[:, None] + widths)
            return state, jnp.mean(state, axis=1)

        start = jnp.broadcast_to(signals[0][:, None], (2, len(PLAYS)))
        if line.periodic:
            start, _ = jax.lax.scan(follow, start, signals)
        _, late = jax.lax.scan(follow, start, signals)
        behind = late - signals
        return free_displacement + self.share * rod.reach * ((1 - self.of_m) * behind[:, 0] + self.of_m * behind[:, 1])
