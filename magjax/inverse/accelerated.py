"""Algorithm (6) compiled by numba, where it is installed: the same walk on arrays as `PlainPreisach.solve`."""

import numpy as np

from ..errors import ConfigurationError
from .operator import ROUNDING


def _arrays(operator):
    stack = np.zeros((2 * operator.cells + len(operator.extrema) + 4096, 2))
    stack[: len(operator.extrema)] = operator.extrema
    numbers = np.array([operator.low, operator.high, operator.step, operator.offset - operator.total, ROUNDING * operator.total])
    return np.array(operator.levels), np.array(operator._table), np.array(operator._diagonal), numbers, stack


def invert_many(operator, targets, slope: float = 0.0):
    """Fields v with slope v + M(v) = target for a sequence, and M there; the operator's memory is led along.

    Returns (fields, magnetizations, saturated, most iterations over n_c + L). Raises `ConfigurationError` without numba.
    """
    kernel = _kernel()
    targets = np.ascontiguousarray(targets, dtype=float)
    if np.isnan(targets).any() or not slope >= 0:
        at = int(np.argmax(np.isnan(targets))) if np.isnan(targets).any() else 0
        raise ConfigurationError(
            f"target {targets[at]} at sample {at} with slope {slope}; give numbers, and a slope of zero or more"
        )
    *arrays, stack = _arrays(operator)
    fields, values, saturated = np.empty(len(targets)), np.empty(len(targets)), np.zeros(len(targets), np.bool_)
    count, excess = kernel.sequence(*arrays, stack, len(operator.extrema), targets, float(slope), fields, values, saturated)
    if count < 0:
        raise ConfigurationError("the memory outgrew its room; invert in shorter pieces")
    operator.extrema = [tuple(row) for row in stack[:count].tolist()]
    return fields, values, saturated, excess


def trapezoid_march(operator, applied, a: float):
    """(4) by the trapezoid with a = mu0 k / h from equilibrium, compiled: (field, magnetization), A/m.

    `applied`: c0 I + H_bias, A/m, (time,). The baseline of the benchmarks; the operator's memory is not changed.
    """
    kernel = _kernel()
    applied = np.ascontiguousarray(applied, dtype=float)
    operator = operator.copy()
    operator.apply(float(applied[0]))
    *arrays, stack = _arrays(operator)
    fields, values = np.empty(len(applied)), np.empty(len(applied))
    kernel.march(*arrays, stack, len(operator.extrema), applied, float(a), float(applied[0]), fields, values)
    return fields, values


def _kernel():
    try:
        from . import kernel
    except ImportError:
        raise ConfigurationError("the accelerated inversion needs numba: pip install numba, or leave accelerate out") from None
    return kernel
