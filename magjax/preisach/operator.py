"""The Preisach operator of T&B Sec. 2.1: field H in, magnetization M out, both A/m.

The Preisach plane beta <= alpha between `low` and `high` is cut at level L into cells; `masses[i, j]` is the mass of
the relays with alpha in row i and beta in column j <= i. With the default surrogate "uniform" each mass is spread
evenly over its cell (T&B Fig. 5), which makes M continuous and differentiable: it is the smooth form of the relay array.
Left out: reversible magnetization, mean field, stress, after-effect, accommodation (effects of those names add them).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..errors import ConfigurationError
from ..param import as_float_array
from .everett import everett_table, table_of
from .memory import apply_field, memory_after, start_history
from .relays import relay_magnetization


def unreached_share(edge, highest, lowest, xp):
    """Area of {alpha > highest, beta < lowest, alpha + beta < 0} in every cell of unit side, (L, L).

    `edge`: the L + 1 levels and `highest`, `lowest` relative to the field of rest, in cells; `xp`: NumPy or jax.numpy.
    """
    x0, x1 = xp.clip(highest, edge[:-1], edge[1:])[:, None], edge[1:, None]
    y0, y1 = edge[None, :-1], xp.clip(lowest, edge[:-1], edge[1:])[None, :]

    def corner(x, y):
        return 0.5 * xp.maximum(-x - y, 0.0) ** 2

    return corner(x0, y0) - corner(x1, y0) - corner(x0, y1) + corner(x1, y1)


class Preisach(eqx.Module):
    """A Preisach operator at discretization level L.

    `masses`: (L, L), A/m, [alpha row, beta column], zero above the diagonal; M runs between `offset` - sum and
    `offset` + sum. `low`, `high`: range of the plane, A/m. `start`: the state before the drive, kept as the history of
    fields that makes it: "negative_saturation", "positive_saturation", "demagnetized" or an array of fields, A/m.
    `rest`: the field about which the material was demagnetized before, A/m: relays that the drive never reaches stay up
    where alpha + beta < 2 rest. `low` (the default) is negative saturation, `high` positive; differentiable, so it can be
    fitted; it enters steady states as `unreached` and other runs through `rested`.
    """

    masses: Float[Array, "L L"]
    low: Float[Array, ""]
    high: Float[Array, ""]
    offset: Float[Array, ""]
    rest: Float[Array, ""]
    history: Float[Array, " extrema"]
    values: Float[Array, "levels levels"] | None

    def __init__(self, masses, low, high, offset=0.0, start="negative_saturation", rest=None):
        masses = as_float_array(masses)
        if masses.ndim != 2 or masses.shape[0] != masses.shape[1]:
            raise ConfigurationError(f"hysteresis.masses must be L x L (alpha rows, beta columns), not {masses.shape}")
        held = np.asarray(masses)  # looked at in NumPy: no program is compiled for it
        if held.min() < 0:
            row, column = np.unravel_index(held.argmin(), held.shape)
            raise ConfigurationError(f"hysteresis.masses[{row}, {column}] is negative; masses must be nonnegative")
        if not high > low:
            raise ConfigurationError(f"the Preisach plane {low}..{high} A/m is empty; give low < high")
        self.masses = masses
        self.low, self.high, self.offset = as_float_array(low), as_float_array(high), as_float_array(offset)
        self.rest = self.low if rest is None else as_float_array(rest)
        self.history = as_float_array(start_history(start, float(low), float(high)))
        self.values = None

    @property
    def cells(self) -> int:
        """The level L of discretization."""
        return self.masses.shape[0]

    @property
    def levels(self):
        """The L + 1 thresholds between cells, A/m."""
        return self.low + (self.high - self.low) * jnp.arange(self.cells + 1) / self.cells

    def unreached(self, highest, lowest):
        """What M gains over a start in negative saturation by relays that a drive between two fields leaves up, A/m."""

        def gained(operator, highest, lowest):
            step = (operator.high - operator.low) / operator.cells
            edge = (operator.levels - operator.rest) / step
            share = unreached_share(edge, (highest - operator.rest) / step, (lowest - operator.rest) / step, jnp)
            density = jnp.tril(operator.masses) * (1.0 + jnp.eye(operator.cells))  # a diagonal cell is half a square
            return 2 * (density.ravel() @ share.ravel())

        # the slopes by the two fields once, not over the plane for every direction of a derivative
        operator, *ends = stop_gradient((self, highest, lowest))
        found = gained(self, *ends)
        for k, (live, end) in enumerate(zip((highest, lowest), ends, strict=True)):
            slope = jax.jvp(lambda x, k=k: gained(operator, *ends[:k], x, *ends[k + 1 :]), (end,), (jnp.ones_like(end),))[1]
            found = found + slope * (live - end)
        return jnp.where(self.rest > self.low, found, 0.0)

    def rested(self, alternations: int = 24) -> "Preisach":
        """The same operator with `rest` written out as a decaying history, for runs that are not periodic."""
        low, high, rest = float(self.low), float(self.high), float(self.rest)
        if rest <= low:
            return self
        heights = max(rest - low, high - rest) * (1 - np.arange(alternations) / alternations)
        history = np.append(np.clip(rest + heights * (-1.0) ** np.arange(alternations), low, high), rest)
        history = np.append(history, np.asarray(self.history))
        made = Preisach(
            self.masses, self.low, self.high, self.offset, history if rest < high else np.append(high, np.asarray(self.history))
        )
        return made

    def table(self):
        """The Everett table that steps read."""
        if self.values is None:
            return everett_table(self.masses, self.low, self.high, self.offset)
        return table_of(self.values, self.low, self.high, self.offset)

    def with_values(self, values: Float[Array, "levels levels"], masses) -> "Preisach":
        """The same operator with other masses whose Everett `values` at the levels are known, A/m: a fit knows those of its basis."""
        return eqx.tree_at(lambda h: (h.masses, h.values), self, (masses, values), is_leaf=lambda x: x is None)

    def memory(self, table, corners: int):
        """The memory at the start, with room for `corners` pairs at least."""
        return memory_after(table, self.history, max(corners, self.history.shape[0] // 2 + 2))

    def magnetization(self, field: Float[Array, " time"], surrogate: str = "uniform", corners: int = 16):
        """M over time for a field sequence, A/m, from the start state.

        `surrogate`: "uniform" (exact for the piecewise-uniform measure), "kp" (finite-slope relays of one cell) or
        "hard" (point relays at the cell centres). Overflow of the memory raises.
        """
        field = jnp.asarray(field, dtype=float)
        if surrogate != "uniform":
            return relay_magnetization(self, field, surrogate)
        table = self.table()
        memory = self.memory(table, corners)

        def advance(memory, value):
            memory = apply_field(table, memory, value)
            return memory, memory.magnetization

        memory, m = jax.lax.scan(advance, memory, field)
        return eqx.error_if(m, memory.overflow, f"the field leaves more than {corners} nested corners; raise corners")
