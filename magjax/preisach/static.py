"""M for a field that is known: the memory is found once, outside JAX, and M is then linear in the masses.

Every sample is one Everett value on top of that of the reversal it branches from: M_k = M_parent +- 2 T(alpha, beta).
Values and gradients in all masses cost a gather and a scatter, whatever the level L. Used for static fits.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ConfigurationError
from .everett import everett_table


class StaticPath(eqx.Module):
    """The branches of a field sequence on a plane. M of sample k is bottom + sum over its chain of sign 2 T.

    `corner_alpha`, `corner_beta`, `corner_sign`: the distinct reversals, each with its running sum over older ones
    given by `older` (matrix-free, by order); `alpha`, `beta`, `sign`, `parent`: per sample.
    """

    alpha: Float[Array, " time"]
    beta: Float[Array, " time"]
    sign: Float[Array, " time"]
    parent: Array
    corner_alpha: Float[Array, " corners"]
    corner_beta: Float[Array, " corners"]
    corner_sign: Float[Array, " corners"]
    corner_parent: Array
    depth: int = eqx.field(static=True)


def static_path(field, low: float) -> StaticPath:
    """Find the memory of a field sequence after negative saturation at `low`, A/m: done once per recording."""
    field = np.asarray(field, float)
    if field.ndim != 1 or len(field) == 0 or not np.all(np.isfinite(field)):
        raise ConfigurationError("the field must be one row of finite samples")
    corners = [(low, low, 0.0, 0)]
    stack = [(low, 0)]  # field of a reversal and its corner number
    rows = np.empty((len(field), 3))
    parents = np.empty(len(field), int)
    depth, last, number = [0], low, None
    previous = 0.0
    for k, value in enumerate(field.tolist()):
        direction = (value > last) - (value < last)
        if direction and direction != previous and k:
            # the last sample was a reversal: it becomes a corner
            alpha, beta, sign = rows[k - 1]
            corners.append((alpha, beta, sign, parents[k - 1]))
            depth.append(depth[parents[k - 1]] + 1)
            stack.append((last, len(corners) - 1))
        previous = direction or previous
        while (
            len(stack) >= 3
            and min(stack[-1][0], stack[-2][0]) > value
            or len(stack) >= 3
            and max(stack[-1][0], stack[-2][0]) < value
        ):
            del stack[-2:]
        if len(stack) == 2 and value <= stack[0][0]:
            del stack[1:]
        base, number = stack[-1]
        rows[k] = (value, base, 2.0) if value >= base else (base, value, -2.0)
        parents[k] = number
        last = value
    columns = np.array([c[:3] for c in corners])
    return StaticPath(
        *(jnp.asarray(rows[:, i]) for i in range(3)), jnp.asarray(parents), *(jnp.asarray(columns[:, i]) for i in range(3)),
        jnp.asarray([c[3] for c in corners]), max(depth),
    )  # fmt: skip


def static_magnetization(masses, low, high, offset, path: StaticPath):
    """M along a path, A/m, (time,); differentiable in the masses."""
    table = everett_table(masses, low, high, offset)
    return _magnetization(table, path, _places(table, path))


def _places(table, path):
    """Cells and local coordinates of the corners and of the samples: what does not depend on the masses."""
    return [(*table.locate(a), *table.locate(b)) for a, b in ((path.corner_alpha, path.corner_beta), (path.alpha, path.beta))]


def _magnetization(table, path, places):
    corners, samples = places
    step, ancestor = path.corner_sign * table.at(*corners), path.corner_parent
    for _ in range(max(path.depth, 1).bit_length()):  # sums over the chain of older corners by doubling
        step, ancestor = step + jnp.where(ancestor == jnp.arange(len(ancestor)), 0.0, step[ancestor]), ancestor[ancestor]
    return table.lowest + step[path.parent] + path.sign * table.at(*samples)


def static_value_and_gradient(loss, low, high, offset, path: StaticPath):
    """masses -> (loss(M), its gradient in all masses), compiled; `loss` takes M, (time,).

    The path goes in as an argument: as a part of the program the compiler copies it many times over (0.7 GB for 1e6 samples).
    """

    @jax.jit
    def run(masses, path, places):
        return jax.value_and_grad(lambda m: loss(_magnetization(everett_table(m, low, high, offset), path, places)))(masses)

    locate = jax.jit(lambda masses, path: _places(everett_table(masses, low, high, offset), path))
    found = {}  # by level

    def value_and_gradient(masses):
        if masses.shape not in found:
            found[masses.shape] = locate(masses, path)
        return run(masses, path, found[masses.shape])

    return value_and_gradient
