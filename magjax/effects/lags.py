"""Helpers for effects whose state lags behind a signal inside the implicit step."""


def lagged(state, before, now, h, tau):
    """x of tau dx/dt + x = u after a step by the trapezoid rule; `before` and `now` are u at its ends."""
    return ((2 * tau - h) * state + h * (before + now)) / (2 * tau + h)
