"""Algorithm (6) compiled by numba, where it is installed: the same walk on arrays as `PlainPreisach.solve`."""

import numpy as np

from ..errors import ConfigurationError

_COMPILED = {}


def invert_many(operator, targets, slope: float = 0.0):
    """Fields v with slope v + M(v) = target for a sequence, and M there; the operator's memory is led along.

    Returns (fields, magnetizations, saturated, most iterations over n_c + L). Raises `ConfigurationError` without numba.
    """
    kernel = _kernel()
    targets = np.ascontiguousarray(targets, dtype=float)
    room = 2 * operator.cells + len(operator.extrema) + 4096
    stack = np.zeros((room, 2))
    stack[: len(operator.extrema)] = operator.extrema
    fields, values, saturated = np.empty(len(targets)), np.empty(len(targets)), np.zeros(len(targets), np.bool_)
    numbers = np.array([operator.low, operator.high, operator.step, operator.offset - operator.total, slope])
    table, diagonal = np.array(operator._table), np.array(operator._diagonal)
    count, excess = kernel(np.array(operator.levels), table, diagonal, numbers, stack, len(operator.extrema), targets, fields, values, saturated)
    if count < 0:
        raise ConfigurationError("the memory outgrew its room; invert in shorter pieces")
    operator.extrema = [tuple(row) for row in stack[:count].tolist()]
    return fields, values, saturated, excess


def _kernel():
    if "kernel" in _COMPILED:
        return _COMPILED["kernel"]
    try:
        from numba import njit
    except ImportError:
        raise ConfigurationError("the accelerated inversion needs numba: pip install numba, or leave accelerate out") from None

    @njit(cache=True)
    def cell_of(levels, L, v, rising):
        k = min(max(int((v - levels[0]) / (levels[L] - levels[0]) * L), 0), L - 1)
        while k < L - 1 and (levels[k + 1] <= v if rising else levels[k + 1] < v):
            k += 1
        while k > 0 and (levels[k] > v if rising else levels[k] >= v):
            k -= 1
        return k

    @njit(cache=True)
    def local(levels, L, step, v):
        k = cell_of(levels, L, v, True)
        return k, (v - levels[k]) / step

    @njit(cache=True)
    def everett(levels, t, d, L, step, alpha, beta):
        i, p = local(levels, L, step, alpha)
        j, q = local(levels, L, step, beta)
        square = (1 - p) * ((1 - q) * t[i, j] + q * t[i, j + 1]) + p * ((1 - q) * t[i + 1, j] + q * t[i + 1, j + 1])
        return square - p * (1 - p) * d[i] - q * (1 - q) * d[j]

    @njit(cache=True)
    def kernel(levels, t, d, numbers, stack, n, targets, fields, values, saturated):
        low, high, step, bottom, slope = numbers
        L = len(d)
        excess = -(1 << 60)
        for index in range(len(targets)):
            target = targets[index]
            corners, iterations = n - 1, 0
            value = slope * stack[n - 1, 0] + stack[n - 1, 1]
            field = stack[n - 1, 0]
            if target != value:
                rising = target > value
                while True:
                    start = stack[n - 1, 0]
                    if (rising and start >= high) or (not rising and start <= low):
                        saturated[index] = True
                        field = (target - stack[n - 1, 1]) / slope if slope > 0 else start
                        break
                    moves = n >= 2 and (stack[n - 1, 0] > stack[n - 2, 0]) == rising
                    b = n - 2 if moves else n - 1
                    base, m_base = stack[b, 0], stack[b, 1]
                    c = n - 3 if moves else n - 2
                    limit = stack[c, 0] if (c >= 0 and not (c == 0 and rising)) else (high if rising else low)
                    cell = cell_of(levels, L, start, rising)
                    edge = levels[cell + 1] if rising else levels[cell]
                    stop = min(edge, limit) if rising else max(edge, limit)
                    iterations += 1
                    if rising:
                        m_stop = m_base + 2 * everett(levels, t, d, L, step, stop, base)
                    else:
                        m_stop = m_base - 2 * everett(levels, t, d, L, step, base, stop)
                    reached = slope * stop + m_stop
                    done = reached >= target if rising else reached <= target
                    if done:
                        j, q = local(levels, L, step, base)
                        bend = q * (1 - q) * d[j]
                        if rising:
                            first = (1 - q) * t[cell, j] + q * t[cell, j + 1] - bend
                            second = (1 - q) * t[cell + 1, j] + q * t[cell + 1, j + 1] - bend
                        else:
                            first = (1 - q) * t[j, cell] + q * t[j + 1, cell] - bend
                            second = (1 - q) * t[j, cell + 1] + q * t[j + 1, cell + 1] - bend
                        c1, c2 = second - first - d[cell], d[cell]
                        sign = 1.0 if rising else -1.0
                        z = (start - levels[cell]) / step
                        here = slope * start + m_base + sign * 2 * (first + c1 * z + c2 * z * z)
                        rho = max(sign * (target - here), 0.0)
                        bb = slope * step + 2 * sign * (c1 + 2 * c2 * z)
                        root = bb + np.sqrt(max(bb * bb + 8 * c2 * rho, 0.0))
                        v = start + sign * (2 * rho / root if root > 0 else 0.0) * step
                        v = min(v, stop) if rising else max(v, stop)
                        if rising:
                            m = m_base + 2 * everett(levels, t, d, L, step, v, base)
                        else:
                            m = m_base - 2 * everett(levels, t, d, L, step, base, v)
                    else:
                        v, m = stop, m_stop
                    if moves:
                        n -= 1
                    if n >= len(stack):
                        return -1, excess
                    stack[n, 0], stack[n, 1] = v, m
                    n += 1
                    while n >= 4 and ((rising and stack[n - 3, 0] <= v) or (not rising and stack[n - 3, 0] >= v)):
                        stack[n - 3, 0], stack[n - 3, 1] = v, m
                        n -= 2
                    if not rising and n == 3 and v <= stack[0, 0]:
                        stack[0, 0], stack[0, 1] = low, bottom
                        n = 1
                    if done:
                        field = v
                        break
            fields[index], values[index] = field, stack[n - 1, 1]
            excess = max(excess, iterations - corners - L)
        return n, excess

    _COMPILED["kernel"] = kernel
    return kernel
