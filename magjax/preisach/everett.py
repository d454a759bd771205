"""The Everett table of a piecewise-uniform Preisach measure, and its exact interpolation.

T(alpha, beta) is the mass of the triangle of relays with thresholds beta <= beta' <= alpha' <= alpha (T&B Sec. 2.1).
Each mass is spread evenly over its cell; cells on the diagonal are triangles. With local coordinates p (in the row of
alpha) and q (in the column of beta), the square cells make T bilinear in its values at the levels, and each diagonal
triangle that is cut adds p^2 - p or q^2 - q times its mass. Storing that mass above the diagonal, T[i, i+1] = D_i,
makes the same formula hold when alpha and beta lie in one cell: p(1-q) + (1-p)q - p(1-p) - q(1-q) = (p - q)^2.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def take(values, index):
    """values[index] for an index within: unsigned, so that no code is made for negative ones (a tenth of a batch's time)."""
    return values[index.astype(jnp.uint32)]


class EverettTable(eqx.Module):
    """T at the levels with the diagonal masses: everything a step reads.

    `values`: (L+1, L+1), [alpha level, beta level], A/m. `diagonal`: (L,), A/m. `low`, `step`: first level and cell
    width, A/m. `total`: the whole mass, A/m; `offset`: constant added to M, A/m.
    """

    values: Float[Array, "levels levels"]
    diagonal: Float[Array, " cells"]
    low: Float[Array, ""]
    step: Float[Array, ""]
    total: Float[Array, ""]
    offset: Float[Array, ""]

    @property
    def cells(self) -> int:
        """The level L of discretization: cells along each threshold."""
        return self.diagonal.shape[0]

    @property
    def lowest(self):
        """M with every relay at -1, A/m."""
        return self.offset - self.total

    def locate(self, field):
        """Cell index and local coordinate in [0, 1] of a field; outside the plane the nearest end."""
        place = jnp.clip((field - self.low) / self.step, 0.0, self.cells)
        cell = jnp.clip(jnp.floor(place), 0, self.cells - 1).astype(int)
        return cell, place - cell

    def __call__(self, alpha, beta):
        """T(alpha, beta), elementwise for alpha >= beta; exact for the piecewise-uniform measure."""
        return self.at(*self.locate(alpha), *self.locate(beta))

    def at(self, i, p, j, q):
        """T in row i and column j of the cells at local coordinates p and q, as `locate` gives them."""
        width = self.cells + 1
        flat = self.values.ravel()
        corner = i * width + j
        bilinear = (1 - p) * ((1 - q) * take(flat, corner) + q * take(flat, corner + 1)) + p * (
            (1 - q) * take(flat, corner + width) + q * take(flat, corner + width + 1)
        )
        return bilinear - p * (1 - p) * take(self.diagonal, i) - q * (1 - q) * take(self.diagonal, j)


def everett_table(masses: Float[Array, "L L"], low, high, offset) -> EverettTable:
    """The table of a mass array [alpha row, beta column], lower triangle, by two cumulative sums."""
    cells = masses.shape[0]
    masses = jnp.tril(masses)
    rows = jnp.cumsum(masses, axis=0)
    both = jnp.cumsum(rows[:, ::-1], axis=1)[:, ::-1]
    values = jnp.zeros((cells + 1, cells + 1), masses.dtype).at[1:, :cells].set(both)
    diagonal = jnp.diagonal(masses)
    above = jnp.arange(cells)
    values = values.at[above, above + 1].set(diagonal)
    return table_of(values, low, high, offset)


def table_of(values: Float[Array, "levels levels"], low, high, offset) -> EverettTable:
    """The table with these values at the levels, the diagonal masses above its diagonal."""
    step = (high - low) / (values.shape[0] - 1)
    return EverettTable(values, jnp.diagonal(values, 1), low, step, values[-1, 0], offset)
