"""Helpers for effects whose state lags behind a signal inside the implicit step."""

import jax.numpy as jnp


def lagged(state, before, now, h, tau):
    """x of tau dx/dt + x = u after a step by the trapezoid rule; `before` and `now` are u at its ends."""
    return ((2 * tau - h) * state + h * (before + now)) / (2 * tau + h)


def repeated(end, start, period, tau):
    """x that repeats after a `period` (s) of a repeating u, from x at the end and start of one."""
    left = jnp.exp(-period / jnp.maximum(tau, 1e-12))
    return (end - left * start) / -jnp.expm1(-period / jnp.maximum(tau, 1e-12))
