"""The walk of algorithm (6) on arrays, compiled by numba on first use; imported only where it is asked for.

`levels`: L + 1 edges of the cells, A/m; `t`, `d`: Everett table (L + 1, L + 1) and half the diagonal's bend (L,); `numbers`: low,
high, step, lowest M and rounding; `stack[:n]`: the corners (field, M) of the memory, oldest first.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def cell_of(levels, L, v, rising):
    """Row that a rising (column that a falling) field moves in, by the stored levels themselves."""
    k = min(max(int((v - levels[0]) / (levels[L] - levels[0]) * L), 0), L - 1)
    while k < L - 1 and (levels[k + 1] <= v if rising else levels[k + 1] < v):
        k += 1
    while k > 0 and (levels[k] > v if rising else levels[k] >= v):
        k -= 1
    return k


@njit(cache=True)
def local(levels, L, step, v):
    """(cell, place in it from 0 to 1) of a field."""
    k = cell_of(levels, L, v, True)
    return k, (v - levels[k]) / step


@njit(cache=True)
def everett(levels, t, d, L, step, alpha, beta):
    """T(alpha, beta), A/m."""
    i, p = local(levels, L, step, alpha)
    j, q = local(levels, L, step, beta)
    square = (1 - p) * ((1 - q) * t[i, j] + q * t[i, j + 1]) + p * ((1 - q) * t[i + 1, j] + q * t[i + 1, j + 1])
    return square - p * (1 - p) * d[i] - q * (1 - q) * d[j]


@njit(cache=True)
def on_branch(levels, t, d, L, step, v, base, m_base, rising):
    """M at field v on the branch from a corner."""
    if rising:
        return m_base + 2 * everett(levels, t, d, L, step, v, base)
    return m_base - 2 * everett(levels, t, d, L, step, base, v)


@njit(cache=True)
def crossing(levels, t, d, L, step, start, stop, cell, base, m_base, rising, target, slope):
    """Where slope v + M(v) meets the target inside a cell: the root of a quadratic, in the form without cancellation."""
    j, q = local(levels, L, step, base)
    bend = q * (1 - q) * d[j]
    if rising:
        first = (1 - q) * t[cell, j] + q * t[cell, j + 1] - bend
        second = (1 - q) * t[cell + 1, j] + q * t[cell + 1, j + 1] - bend
    else:
        first = (1 - q) * t[j, cell] + q * t[j + 1, cell] - bend
        second = (1 - q) * t[j, cell + 1] + q * t[j + 1, cell + 1] - bend
    sign = 1.0 if rising else -1.0
    c1, c2 = second - first - d[cell], d[cell]
    z = (start - levels[cell]) / step
    here = slope * start + m_base + sign * 2 * (first + c1 * z + c2 * z * z)
    rho = max(sign * (target - here), 0.0)
    bb = slope * step + 2 * sign * (c1 + 2 * c2 * z)
    root = bb + np.sqrt(max(bb * bb + 8 * c2 * rho, 0.0))
    found = start + sign * (2 * rho / root if root > 0 else 0.0) * step
    return min(found, stop) if rising else max(found, stop)


@njit(cache=True)
def advance(stack, n, v, m, rising, moves, low, bottom):
    """The number of corners after the field has moved to v, with M there; -1 where the room is too small."""
    if moves:
        n -= 1
    if n >= len(stack):
        return -1
    stack[n, 0], stack[n, 1] = v, m
    n += 1
    while n >= 4 and ((rising and stack[n - 3, 0] <= v) or (not rising and stack[n - 3, 0] >= v)):
        stack[n - 3, 0], stack[n - 3, 1] = v, m
        n -= 2
    if not rising and n == 3 and v <= stack[0, 0]:
        stack[0, 0], stack[0, 1] = low, bottom
        n = 1
    return n


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
    while True:
        start = stack[n - 1, 0]
        if (rising and start >= high) or (not rising and start <= low):
            return n, ((target - stack[n - 1, 1]) / slope if slope > 0 else start), True, iterations
        moves = n >= 2 and (stack[n - 1, 0] > stack[n - 2, 0]) == rising
        b, c = (n - 2, n - 3) if moves else (n - 1, n - 2)
        base, m_base = stack[b, 0], stack[b, 1]
        limit = stack[c, 0] if (c >= 0 and not (c == 0 and rising)) else (high if rising else low)
        cell = cell_of(levels, L, start, rising)
        v = min(levels[cell + 1], limit) if rising else max(levels[cell], limit)
        iterations += 1
        m = on_branch(levels, t, d, L, step, v, base, m_base, rising)
        reached = slope * v + m
        done = reached >= target - near if rising else reached <= target + near
        if done:
            v = crossing(levels, t, d, L, step, start, v, cell, base, m_base, rising, target, slope)
            if v == start:
                return n, v, False, iterations
            m = on_branch(levels, t, d, L, step, v, base, m_base, rising)
        n = advance(stack, n, v, m, rising, moves, low, bottom)
        if done or n < 0:
            return n, v, False, iterations


@njit(cache=True)
def sequence(levels, t, d, numbers, stack, n, targets, slope, fields, values, saturated):
    """Targets one after the other into `fields`, `values`, `saturated`; (corners, most iterations over n_c + L)."""
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
