"""Mechanics: free displacement u (m) -> displacement y (m).

T&B (5): y'' + 2 xi w0 y' + w0^2 y = w0^2 u, w0 = 2 pi f0. Periodic signals are filtered exactly in the frequency domain;
others by the exact response to a forcing that is linear between samples (first-order hold), from equilibrium.
Left out: higher modes (second_mode), stiffness that varies (duffing_stiffness, delta_e), friction, backlash, creep, heat.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..linear import exponential_of
from ..param import param


class Mechanics(eqx.Module):
    """One damped mode, T&B (5)."""

    f0: Float[Array, ""] = param(392.0, "Hz", "first resonance frequency", low=0.0, typical=(50.0, 2e4))
    xi: Float[Array, ""] = param(0.7783, "1", "damping ratio", low=0.0, typical=(0.01, 1.5))

    def response(self, s):
        """G(s) = w0^2 / (s^2 + 2 xi w0 s + w0^2), unit gain at rest."""
        w0 = 2 * jnp.pi * self.f0
        return w0**2 / (s * s + 2 * self.xi * w0 * s + w0**2)

    def __call__(self, free_displacement, line):
        """Displacement over time, m."""
        if line.periodic:
            return line.filter(free_displacement, self.response)
        return self._march(free_displacement, line.dt)

    def held(self, dt):
        """Exact step of the state (y, y'/w0) for a forcing linear in between: A (2, 2), gains of its start and of its rise, (2,).

        state <- A @ state + gain * forcing + rise * (next forcing - forcing).
        """
        w0 = 2 * jnp.pi * self.f0
        zero, one = jnp.zeros_like(w0), jnp.ones_like(w0)
        # states y, y'/w0 with the forcing's present value and its slope a step appended: one matrix exponential is exact;
        # y' itself would make entries of w0^2, too large for it where a step holds many periods of a stiff stack
        rows = [[zero, w0, zero, zero], [-w0, -2 * self.xi * w0, w0, zero], [zero, zero, zero, one / dt], [zero] * 4]
        full = exponential_of(dt * jnp.stack([jnp.stack(r) for r in rows]))
        return full[:2, :2], full[:2, 2], full[:2, 3]

    def _march(self, u, dt):
        A, gain, rise = self.held(dt)

        def advance(state, pair):
            now, following = pair
            state = A @ state + gain * now + rise * (following - now)
            return state, state[0]

        start = jnp.stack([u[0], jnp.zeros_like(u[0])])
        _, y = jax.lax.scan(advance, start, (u[:-1], u[1:]))
        return jnp.concatenate([u[:1], y])
