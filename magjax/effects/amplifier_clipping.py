"""source: the amplifier's voltage is bounded, |L dI/dt + R I| <= V_max."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

NO_LIMIT = 1e6  # A: voltage over resistance that no bench asks for


class AmplifierClipping(AbstractEffect):
    """A supply of limited voltage: the current follows its command while R I + L dI/dt stays within +-V_max, else it
    moves as that voltage lets it and meets the command again later.

    The exact law of the current, by the implicit Euler step; with g = R / V_max a limit that nothing reaches is no limit, so
    there is no derivative at null: the screening tries limits just below what the recordings ask for. Left out: the
    voltage N A dB/dt beyond its linear part, which tau_L holds.
    """

    inverse_limit: Float[Array, ""] = param(
        0.0,
        "1/A",
        "resistance over largest voltage: one over the largest steady current",
        low=0.0,
        scale=0.1,
        null=0.0,
        typical=(0.3, 3.0),
    )
    tau_L: Float[Array, ""] = param(1e-3, "s", "L/R of coil and leads", low=0.0, scale=1e-3, shape=True, typical=(1e-4, 1e-2))

    name = "amplifier_clipping"
    block = "source"
    law = "|I + tau_L dI/dt| <= 1 / g, I = command wherever that allows it"
    source = "voltage compliance of a linear amplifier, |L dI/dt + R I| <= V_max"
    signature = "flattened crests at the largest amplitude, at high frequency first; nothing below the limit"
    amplitude = "inverse_limit"
    magnetic = True

    @classmethod
    def finite_trials(cls, drives, steps):
        """Limits at which to score it: parameters for shares of the largest voltage that the drives ask for."""
        found = []
        for tau in (0.0, 1e-3, 4e-3):
            peak = 0.0
            for drive, dt in zip(drives, steps, strict=True):
                rate = (np.roll(drive, -1, axis=-1) - np.roll(drive, 1, axis=-1)) / (2 * np.asarray(dt)[:, None])
                peak = max(peak, float(np.max(np.abs(drive + tau * rate))))
            found += [{"tau_L": tau, "inverse_limit": 1 / (share * peak)} for share in (0.97, 0.9, 0.75)]
        return found

    def drive(self, current, line, actuator):
        """Current as the voltage lets it follow."""
        limit = 1 / jnp.maximum(self.inverse_limit, 1 / NO_LIMIT)
        a = self.tau_L / line.dt

        def follow(before, command):
            now = jnp.clip(command, (a * before - limit) / (1 + a), (a * before + limit) / (1 + a))
            return now, now

        first = current[-1] if line.periodic else current[0]
        last, once = jax.lax.scan(follow, first, current)
        return jax.lax.scan(follow, last, current)[1] if line.periodic else once
