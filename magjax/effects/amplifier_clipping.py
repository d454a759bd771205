"""source: the amplifier's voltage is bounded, |L dI/dt + R I + N A dB/dt| <= V_max."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

NO_LIMIT = 1e6  # A: voltage over resistance that no bench asks for


class AmplifierClipping(AbstractEffect):
    """A supply of limited voltage: the current follows its command while R I + L dI/dt + N A dB/dt stays within +-V_max, else it
    moves as that voltage lets it and meets the command again later.

    The exact law, inside the step of (4), for the flux answers the current; L is of what the rod does not fill. With g = R / V_max a
    limit that nothing reaches is no limit, so there is no derivative at null: the screening tries limits just below what the
    recordings ask for. In detail the flux of the rod counts, which otherwise tau_L stands for, the limit may be round, and that of one
    sign higher than that of the other.
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
    linkage: Float[Array, ""] = param(
        0.0, "A s/T", "turns times area over resistance", low=0.0, scale=5e-3, shape=True, detail=True, typical=(1e-3, 5e-2)
    )
    softness: Float[Array, ""] = param(
        0.0, "1", "how round the limit is, as a hyperbola, of its voltage", low=0.0, scale=0.05, shape=True, detail=True, typical=(0.0, 0.3)
    )

    unevenness: Float[Array, ""] = param(
        0.0, "1", "how far the upper limit is above their mean, of it, and the lower one below", low=-0.9, high=0.9, scale=0.05, shape=True, detail=True,
        typical=(-0.2, 0.2),
    )  # fmt: skip

    name = "amplifier_clipping"
    block = "source"
    law = (
        "|I + tau_L dI/dt + linkage dB/dt - a / g| <= 1 / g, a the unevenness, I = command wherever that allows it; with softness s the voltage "
        "asked for, from its mean limit and over its limit, u becomes (sqrt((u + 1)^2 + s^2) - sqrt((u - 1)^2 + s^2)) / 2"
    )
    source = "voltage compliance of a linear amplifier, |L dI/dt + R I + N A dB/dt| <= V_max"
    signature = "flattened crests at the largest amplitude, at high frequency first; nothing below the limit"
    amplitude = "inverse_limit"
    magnetic = True
    in_step = True

    @classmethod
    def finite_trials(cls, drives, fluxes, steps):
        """Limits at which to score it: parameters for shares of the largest voltage that the drives ask for, which the coil's own
        flux makes, or that of the rod, with a limit a little round: then it is the hysteresis that runs into it, and no share of dI/dt
        looks like that."""
        found = []
        for tau, linkage in ((0.0, 0.0), (1e-3, 0.0), (4e-3, 0.0), (1e-3, 3e-3), (1e-3, 3e-2)):
            peak = 0.0
            for drive, flux, dt in zip(drives, fluxes, steps, strict=True):
                linked = tau * drive + linkage * flux
                rate = (np.roll(linked, -1) - np.roll(linked, 1)) / (2 * dt)
                peak = max(peak, float(np.max(np.abs(drive + rate))))
            behind = {"linkage": linkage, "softness": 0.02} if linkage else {}
            found += [{"tau_L": tau, **behind, "inverse_limit": 1 / (share * peak)} for share in (0.97, 0.9, 0.75)]
        return found

    def _current(self, command, before, flux_rate, h):
        limit = 1 / jnp.maximum(self.inverse_limit, 1 / NO_LIMIT)
        a = self.tau_L / h
        room = limit / (1 + a)
        middle = (a * before - self.linkage * flux_rate) / (1 + a) + self.unevenness * room
        u, is_round = (command - middle) / room, self.softness > 0
        width = jnp.where(is_round, self.softness, 1.0) ** 2
        soft = middle + 0.5 * room * (jnp.sqrt((u + 1) ** 2 + width) - jnp.sqrt((u - 1) ** 2 + width))
        return jnp.where(is_round, soft, jnp.clip(command, middle - room, middle + room))

    def start(self, trial, actuator):
        """(current, field that it falls short of) at rest."""
        current = self._current(trial.current, trial.current, 0.0, jnp.inf)
        return current, actuator.coil.applied_field(trial.current) - actuator.coil.applied_field(current)

    def field_shift(self, trial, state, actuator):
        """Applied field that the current falls short of, A/m."""
        short = self.advance(trial, state, actuator)[1]
        return short if actuator.coil.scheme == "bdf2" else 0.5 * (short + state[1])

    def advance(self, trial, state, actuator):
        """The current after the step, and the field that it falls short of."""
        current = self._current(trial.current, state[0], trial.flux_rate, trial.h)
        return current, actuator.coil.applied_field(trial.current) - actuator.coil.applied_field(current)

    def delivered(self, current, flux_density, line, actuator):
        """The current, A, for the flux density that it made."""
        B = jnp.pad(flux_density, (2, 0), "wrap" if line.periodic else "edge")
        bdf = actuator.coil.scheme == "bdf2"
        rate = (1.5 * B[2:] - 2 * B[1:-1] + 0.5 * B[:-2] if bdf else B[2:] - B[1:-1]) / line.dt

        def follow(before, now):
            there = self._current(now[0], before, now[1], line.dt)
            return there, there

        last, once = jax.lax.scan(follow, current[-1] if line.periodic else current[0], (current, rate))
        return jax.lax.scan(follow, last, (current, rate))[1] if line.periodic else once
