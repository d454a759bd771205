"""Helpers for effects that lag behind a signal through a spread of times."""

import jax.numpy as jnp

from ..param import param


def power_of_time(typical):
    """The declared parameter by which a spread of lags leans; `typical`: its expected range."""
    meaning = "power of time: slow lags weigh more where it is positive"
    return param(0.0, "1", meaning, low=-0.5, high=0.5, scale=0.1, shape=True, detail=True, typical=typical)


def lagged(state, before, now, h, tau):
    """x of tau dx/dt + x = u after a step by the trapezoid rule; `before` and `now` are u at its ends."""
    return ((2 * tau - h) * state + h * (before + now)) / (2 * tau + h)


def repeated(end, start, period, tau):
    """x that repeats after a `period` (s) of a repeating u, from x at the end and start of one."""
    left = jnp.exp(-period / jnp.maximum(tau, 1e-12))
    return (end - left * start) / -jnp.expm1(-period / jnp.maximum(tau, 1e-12))
