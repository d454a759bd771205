"""magnetostriction: the strain lags behind M^2 on its own, rate-independently."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

PLAYS = (0.1, 0.3, 0.6, 1.0)  # half-widths relative to the widest
NARROWEST = 1e-6  # width, below which Dahl's law has no way to turn in


class StrainHysteresis(AbstractEffect):
    """A few play operators on the free displacement u or, `of_m`, on the magnetization, what they lag then added to u as it is; `smooth`
    puts Dahl's law in their place, which is behind by as much in the end, half the width.

    A lag of M itself, in its square, would be one of the hysteresis: it is what the density does.
    """

    share: Float[Array, ""] = param(0.0, "1", "share of the strain that lags", scale=0.1, null=0.0, typical=(0.01, 0.5))

    width: Float[Array, ""] = param(
        0.1, "1", "half-width of the widest play relative to saturation", low=0.0, scale=0.1, shape=True, typical=(0.01, 0.3)
    )
    of_m: Float[Array, ""] = param(
        0.0, "1", "0: the lag is along the path of the strain, 1: of M", low=0.0, high=1.0, scale=0.5, shape=True, typical=(0.0, 1.0)
    )
    smooth: Float[Array, ""] = param(
        0.0, "1", "0: plays, 1: Dahl's law, which gives way at once", low=0.0, high=1.0, scale=0.5, shape=True, typical=(0.0, 1.0)
    )

    name = "strain_hysteresis"
    block = "magnetostriction"
    law = (
        "u -> u - h u_s [(1 - of_m) z(u/u_s) + of_m z(m)], m = M/M_s, u_s = lambda_s l_rod, z(x) = (1 - smooth) mean_i(x - play_ri(x)) + smooth d, "
        "r = 10, 30, 60, 100 % of the width, dd = dx - |dx| d/(width/2)"
    )
    source = (
        "hysteresis of lambda against M^2 in Terfenol-D (M. Moffett et al., J. Acoust. Soc. Am. 89 (1991) 1448); "
        "along M, as a Bouc-Wen or Jiles-Atherton law of the domains' strain has it; P. Dahl, AIAA J. 14 (1976) 1675"
    )
    signature = "a lag of y that does not depend on frequency and is absent in M"
    amplitude = "share"

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement with plays, m."""
        rod = actuator.magnetostriction
        widths = jnp.asarray(PLAYS) * jnp.maximum(self.width, 0.0)
        signals = jnp.stack([free_displacement / rod.reach, magnetization / rod.M_s], axis=1)

        way = 0.5 * jnp.maximum(self.width, NARROWEST)

        def follow(state, now):
            plays, turned, before = state
            plays = jnp.clip(plays, now[:, None] - widths, now[:, None] + widths)
            moved = now - before
            end = way * jnp.sign(moved)
            turned = end + (turned - end) * jnp.exp(-jnp.abs(moved) / way)  # of a motion one way, exactly
            return (plays, turned, now), (1 - self.smooth) * (now - jnp.mean(plays, axis=1)) + self.smooth * turned

        start = jnp.broadcast_to(signals[0][:, None], (2, len(PLAYS))), jnp.zeros(2), signals[0]
        if line.periodic:
            start, _ = jax.lax.scan(follow, start, signals)
        _, behind = jax.lax.scan(follow, start, signals)
        return free_displacement - self.share * rod.reach * ((1 - self.of_m) * behind[:, 0] + self.of_m * behind[:, 1])
