"""magnetostriction: the strain lags behind M^2 on its own, rate-independently."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

PLAYS = (0.1, 0.3, 0.6, 1.0)  # half-widths relative to the widest


class StrainHysteresis(AbstractEffect):
    """A few play operators on the free displacement: u + h sum_i (play_i(u) - u)/n."""

    share: Float[Array, ""] = param(0.0, "1", "share of the strain that lags", scale=0.1, null=0.0, typical=(0.01, 0.5))

    width: Float[Array, ""] = param(
        0.1, "1", "half-width of the widest play relative to saturation strain", low=0.0, scale=0.1, shape=True, typical=(0.01, 0.3)
    )

    name = "strain_hysteresis"
    block = "magnetostriction"
    law = "u -> u + h mean_i(play_ri(u) - u), r = 10, 30, 60, 100 % of the width"
    source = "hysteresis of lambda against M^2 in Terfenol-D (M. Moffett et al., J. Acoust. Soc. Am. 89 (1991) 1448)"
    signature = "a lag of y that does not depend on frequency and is absent in M"
    amplitude = "share"

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with plays, m."""
        widths = jnp.asarray(PLAYS) * jnp.maximum(self.width, 0.0) * actuator.magnetostriction.reach

        def follow(state, u):
            state = jnp.clip(state, u - widths, u + widths)
            return state, jnp.mean(state)

        start = jnp.broadcast_to(free_displacement[0], widths.shape)
        if line.periodic:
            start, _ = jax.lax.scan(follow, start, free_displacement)
        _, late = jax.lax.scan(follow, start, free_displacement)
        return free_displacement + self.share * (late - free_displacement)
