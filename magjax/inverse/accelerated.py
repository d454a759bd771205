"""Algorithm (6) compiled by numba, where it is installed: the same walk on arrays as `PlainPreisach.solve`."""

import numpy as np

from ..errors import ConfigurationError
from .operator import ROUNDING

_COMPILED = {}


def _arrays(operator):
    stack = np.zeros((2 * operator.cells + len(operator.extrema) + 4096, 2))
    stack[: len(operator.extrema)] = operator.extrema
    numbers = np.array([operator.low, operator.high, operator.step, operator.offset - operator.total, ROUNDING * operator.total])
    return np.array(operator.levels), np.array(operator._table), np.array(operator._diagonal), numbers, stack


def invert_many(operator, targets, slope: float = 0.0):
    """Fields v with slope v + M(v) = target for a sequence, and M there; the operator's memory is led along.

    Returns (fields, magnetizations, saturated, most iterations over n_c + L). Raises `ConfigurationError` without numba.
    """
    sequence, _ = _kernel()
    targets = np.ascontiguousarray(targets, dtype=float)
    if np.isnan(targets).any() or not slope >= 0:
        at = int(np.argmax(np.isnan(targets))) if np.isnan(targets).any() else 0
        raise ConfigurationError(
            f"target {targets[at]} at sample {at} with slope {slope}; give numbers, and a slope of zero or more"
        )
    *arrays, stack = _arrays(operator)
    fields, values, saturated = np.empty(len(targets)), np.empty(len(targets)), np.zeros(len(targets), np.bool_)
    count, excess = sequence(*arrays, stack, len(operator.extrema), targets, float(slope), fields, values, saturated)
    if count < 0:
        raise ConfigurationError("the memory outgrew its room; invert in shorter pieces")
    operator.extrema = [tuple(row) for row in stack[:count].tolist()]
    return fields, values, saturated, excess


def trapezoid_march(operator, applied, a: float):
    """(4) by the trapezoid with a = mu0 k / h from equilibrium, compiled: (field, magnetization), A/m.

    `applied`: c0 I + H_bias, A/m, (time,). The baseline of the benchmarks; the operator's memory is not changed.
    """
    _, march = _kernel()
    applied = np.ascontiguousarray(applied, dtype=float)
    operator = operator.copy()
    operator.apply(float(applied[0]))
    *arrays, stack = _arrays(operator)
    fields, values = np.empty(len(applied)), np.empty(len(applied))
    march(*arrays, stack, len(operator.extrema), applied, float(a), float(applied[0]), fields, values)
    return fields, values


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
    def solve(levels, t, d, numbers, stack, n, target, slope):
        """(corners + 1, field, saturated, iterations) after one target; n = -1 where the room is too small."""
        low, high, step, bottom = numbers[0], numbers[1], numbers[2], numbers[3]
        L, iterations = len(d), 0
        value = slope * stack[n - 1, 0] + stack[n - 1, 1]
        if target == value:
            return n, stack[n - 1, 0], False, 0
        rising = target > value
        near = numbers[4] if slope == 0 else 0.0
        sign = 1.0 if rising else -1.0
        while True:
            start = stack[n - 1, 0]
            if (rising and start >= high) or (not rising and start <= low):
                return n, ((target - stack[n - 1, 1]) / slope if slope > 0 else start), True, iterations
            moves = n >= 2 and (stack[n - 1, 0] > stack[n - 2, 0]) == rising
            b = n - 2 if moves else n - 1
            base, m_base = stack[b, 0], stack[b, 1]
            c = n - 3 if moves else n - 2
            limit = stack[c, 0] if (c >= 0 and not (c == 0 and rising)) else (high if rising else low)
            cell = cell_of(levels, L, start, rising)
            edge = levels[cell + 1] if rising else levels[cell]
            v = min(edge, limit) if rising else max(edge, limit)
            iterations += 1
            if rising:
                m = m_base + 2 * everett(levels, t, d, L, step, v, base)
            else:
                m = m_base - 2 * everett(levels, t, d, L, step, base, v)
            reached = slope * v + m
            done = reached >= target - near if rising else reached <= target + near
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
                z = (start - levels[cell]) / step
                here = slope * start + m_base + sign * 2 * (first + c1 * z + c2 * z * z)
                rho = max(sign * (target - here), 0.0)
                bb = slope * step + 2 * sign * (c1 + 2 * c2 * z)
                root = bb + np.sqrt(max(bb * bb + 8 * c2 * rho, 0.0))
                found = start + sign * (2 * rho / root if root > 0 else 0.0) * step
                v = min(found, v) if rising else max(found, v)
                if v == start:
                    return n, v, False, iterations
                if rising:
                    m = m_base + 2 * everett(levels, t, d, L, step, v, base)
                else:
                    m = m_base - 2 * everett(levels, t, d, L, step, base, v)
            if moves:
                n -= 1
            if n >= len(stack):
                return -1, v, False, iterations
            stack[n, 0], stack[n, 1] = v, m
            n += 1
            while n >= 4 and ((rising and stack[n - 3, 0] <= v) or (not rising and stack[n - 3, 0] >= v)):
                stack[n - 3, 0], stack[n - 3, 1] = v, m
                n -= 2
            if not rising and n == 3 and v <= stack[0, 0]:
                stack[0, 0], stack[0, 1] = low, bottom
                n = 1
            if done:
                return n, v, False, iterations

    @njit(cache=True)
    def sequence(levels, t, d, numbers, stack, n, targets, slope, fields, values, saturated):
        excess = -(1 << 60)
        for index in range(len(targets)):
            corners = n - 1
            n, fields[index], saturated[index], iterations = solve(levels, t, d, numbers, stack, n, targets[index], slope)
            if n < 0:
                return n, excess
            values[index] = stack[n - 1, 1]
            excess = max(excess, iterations - corners - len(d))
        return n, excess

    @njit(cache=True)
    def march(levels, t, d, numbers, stack, n, applied, a, H, fields, values):
        """The trapezoid of (4): (1/2 + a) v + a M = a X0 - H0/2 + (applied 0 + applied 1)/2."""
        M = stack[n - 1, 1]
        fields[0], values[0] = H, M
        for k in range(1, len(applied)):
            rhs = a * (H + M) - 0.5 * H + 0.5 * (applied[k - 1] + applied[k])
            n, H, _, _ = solve(levels, t, d, numbers, stack, n, rhs / a, (0.5 + a) / a)
            M = stack[n - 1, 1]
            fields[k], values[k] = H, M
        return n

    _COMPILED["kernel"] = sequence, march
    return _COMPILED["kernel"]
