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
