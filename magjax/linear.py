"""Linear algebra within compiled programs."""

import jax
import jax.numpy as jnp


@jax.custom_batching.sequential_vmap
def inverse_of(matrix):
    """The inverse of (n, n); of a batch, one after another.

    jaxlib (0.10) splits a batch that is too large for one task among the threads that programs run on and waits there: two programs
    at once, as of fits side by side, then wait for one another forever.
    """
    return jnp.linalg.inv(matrix)


def inverse_of_definite(matrix):
    """The inverse of a small (n, n) that is a positive definite one with its columns scaled, by Gauss-Jordan steps: these need no
    pivots, and a batch is a matter of plain arithmetic, where LAPACK is called for one matrix after another."""
    n = matrix.shape[0]
    for k in range(n):
        pivot, here = 1 / matrix[k, k], jnp.arange(n) == k
        row, column = matrix[k] * pivot, matrix[:, k] * pivot
        swept = matrix - matrix[:, k, None] * row
        swept = jnp.where(here[:, None], row, jnp.where(here, -column[:, None], swept))
        matrix = jnp.where(here[:, None] & here, pivot, swept)
    return matrix


TERMS = 14  # of the series: 0.5^15 / 15! is below rounding
MOST_SQUARINGS = 40  # a norm of 2^39


def exponential_of(matrix):
    """exp of (n, n) by scaling and squaring of its series: products alone, so that batches of it are no work for LAPACK."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(matrix), axis=1)))
    squarings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 1e-300))) + 1, 0, MOST_SQUARINGS)
    scaled = matrix * 2.0**-squarings
    one = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    total = one
    for k in range(TERMS, 0, -1):
        total = one + scaled @ total / k
    return jax.lax.fori_loop(0, MOST_SQUARINGS, lambda k, x: jnp.where(k < squarings, x @ x, x), total)
