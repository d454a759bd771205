"""One step of (4) in closed form: the field v with p v + q M(v) = rhs, strictly monotone and piecewise quadratic in v.

Corners that the step wipes out follow from stored values, the cell by a search over the levels, the rest from a quadratic;
where a derivative is asked for, one Newton polish with a frozen slope, which adds nothing to the value, makes it exact.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient

from ..preisach.everett import take
from ..preisach.memory import Memory, branch_magnetization


def solve_frozen(table, memory: Memory, p, q, rhs):
    """The field v with p v + q M(v) = rhs, without a derivative: (v, M(v), rising, kept)."""
    table, memory, p, q, rhs = stop_gradient((table, memory, p, q, rhs))
    rising = rhs >= p * memory.field + q * memory.magnetization
    up = jnp.sum(p * memory.maxima + q * memory.m_maxima > rhs)
    down = jnp.sum(p * memory.minima + q * memory.m_minima < rhs)
    kept = jnp.where(rising, up, down)
    branch = memory.select(table, rising, kept)
    v, m = _locate(table, branch, p, q, rhs)
    return v, m, rising, branch[1]


@jax.custom_jvp
def solve_branch(table, memory: Memory, p, q, rhs):
    """As `solve_frozen`, with exact derivatives of v and M. The polish that makes them is done where one is asked for."""
    return solve_frozen(table, memory, p, q, rhs)


def pushed(function, given, tangents):
    """`function(*given)` and its change along the tangents that a rule with `symbolic_zeros` is handed."""
    leaves, tree = jax.tree.flatten(given)
    directions = tree.flatten_up_to(tangents)
    moving = [k for k, d in enumerate(directions) if type(d) is not SymbolicZero]

    def there(*moved):
        at = list(leaves)
        for k, leaf in zip(moving, moved, strict=True):
            at[k] = leaf
        return function(*jax.tree.unflatten(tree, at))

    return jax.jvp(there, [leaves[k] for k in moving], [directions[k] for k in moving])


def unmoved(x):
    """The change of a flag or a number, which have none."""
    return np.zeros(x.shape, jax.dtypes.float0)


def _polished(given, tangents):
    v, m, rising, kept = solve_frozen(*given)

    def there(table, memory, p, q, rhs):
        return polish(table, memory, rising, kept, v, p, q, rhs)

    (v, m), change = pushed(there, given, tangents)
    return (v, m, rising, kept), (*change, *map(unmoved, (rising, kept)))


solve_branch.defjvp(_polished, symbolic_zeros=True)


def polish(table, memory, rising, kept, v, p, q, rhs, extra=0.0, extra_slope=0.0):
    """One Newton step with frozen slope from a solution v of p v + q M(v) + extra = rhs: its value stays, to
    rounding, and every derivative becomes that of the implicit function."""
    _, _, threshold, m_there = memory.select(table, rising, kept)
    m_slope = slope_of(*stop_gradient((table, v, threshold, rising)))
    m = branch_magnetization(table, rising, threshold, m_there, v)
    change = -((p * v + q * m - rhs) + extra) / stop_gradient(p + q * m_slope + extra_slope)
    return v + change, m + m_slope * change


def _level_values(table, cell, fixed, share, rising):
    """T on the branch at both ends of a cell: T(level, threshold) rising, T(threshold, level) falling."""
    width = table.cells + 1
    flat = table.values.ravel()
    here = jnp.where(rising, cell * width + fixed, fixed * width + cell)
    along, across = jnp.where(rising, width, 1), jnp.where(rising, 1, width)
    bend = share * (1 - share) * take(table.diagonal, fixed)
    first = (1 - share) * take(flat, here) + share * take(flat, here + across) - bend
    second = (1 - share) * take(flat, here + along) + share * take(flat, here + along + across) - bend
    return first, second


def slope_of(table, field, threshold, rising):
    """dM/dv on a branch: 2 dT/dalpha rising, -2 dT/dbeta falling; zero outside the plane."""
    inside = (field > table.low) & (field < table.low + table.cells * table.step)
    cell, local = table.locate(field)
    first, second = _level_values(table, cell, *table.locate(threshold), rising)
    slope = (second - first) + (2 * local - 1) * take(table.diagonal, cell)
    return jnp.where(inside, jnp.where(rising, 2.0, -2.0) * slope / table.step, 0.0)


def _locate(table, branch, p, q, rhs):
    """The solution and M there, all inputs frozen: a search over the levels, then the quadratic of one cell."""
    rising, _, threshold, m_there = branch
    L, width = table.cells, table.cells + 1
    fixed, share = table.locate(threshold)
    sign = jnp.where(rising, 1.0, -1.0)
    flat = table.values.ravel()
    base = jnp.where(rising, fixed, fixed * width)
    along, across = jnp.where(rising, width, 1), jnp.where(rising, 1, width)
    constant = p * table.low + q * (m_there - 2 * sign * share * (1 - share) * take(table.diagonal, fixed)) - rhs

    def not_above(level):
        at = base + level * along
        T = (1 - share) * take(flat, at) + share * take(flat, at + across)
        value = constant + p * level * table.step + 2 * q * sign * T
        # rising the branch runs over the levels above the threshold, falling over those below it
        return jnp.where(rising, (level <= fixed) | (value <= 0), (value <= 0) & (level <= fixed))

    # the last level not above the solution, two levels at once in ever finer strides: where one or three are tried, the
    # compiler's loops are two to three times slower
    cell = 0
    for stride in _strides(L):
        levels = cell + stride * jnp.arange(1, 3)
        cell = cell + stride * jnp.sum(not_above(jnp.minimum(levels, L)) & (levels < L))

    # in the cell T = first + (second - first - D) z + D z^2; go from the anchor by the distance rho that is left
    first, second = _level_values(table, cell, fixed, share, rising)
    D = take(table.diagonal, cell)
    anchor = jnp.where(cell == fixed, share, jnp.where(rising, 0.0, 1.0))
    T_anchor = first + (second - first - D) * anchor + D * anchor**2
    slope = sign * (second - first - D + 2 * D * anchor)
    rho = sign * (rhs - p * (table.low + (cell + anchor) * table.step) - q * (m_there + 2 * sign * T_anchor))
    rho = jnp.maximum(rho, 0.0)
    b = p * table.step + 2 * q * slope
    z = anchor + sign * 2 * rho / (b + jnp.sqrt(b * b + 8 * q * D * rho))
    v = table.low + (cell + z) * table.step
    m = m_there + 2 * sign * (first + (second - first - D + D * z) * z)
    # outside the plane every relay is saturated and the equation linear
    m_top = table.offset + table.total
    above = p * (table.low + L * table.step) + q * m_top < rhs
    below = p * table.low + q * table.lowest > rhs
    m = jnp.where(above, m_top, jnp.where(below, table.lowest, m))
    return jnp.where(above | below, (rhs - q * m) / p, v), m


def _strides(cells):
    """Strides, coarse to fine, so that two levels tried at each end in one cell of so many."""
    strides = [1]
    while 3 * strides[-1] < cells:
        strides.append(3 * strides[-1])
    return strides[::-1]
