"""The memory of the Preisach operator: the corners of its memory curve as padded alternating extrema.

Pairs (maxima[k], minima[k]) hold the past extrema of the field that still matter: maxima fall, minima rise with k.
Unused pairs sit at the present field with no area between them, so a rising field that passes a maximum, or a falling
one that passes a minimum, wipes out corners by two `where`s, with no push or pop: it batches and differentiates.
M is stored at each corner (return-point memory), so that no error accumulates.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..errors import ConfigurationError
from ..extrema import wiped

TOUCHED = 1e-12  # of the fields in the memory: maxima as near as that are one


class Memory(eqx.Module):
    """Corners of the memory curve with the magnetization at each, A/m; `overflow` tells that a corner was lost."""

    maxima: Float[Array, " corners"]
    minima: Float[Array, " corners"]
    m_maxima: Float[Array, " corners"]
    m_minima: Float[Array, " corners"]
    field: Float[Array, ""]
    magnetization: Float[Array, ""]
    overflow: Bool[Array, ""]

    @property
    def corners(self) -> int:
        """How many pairs of extrema there is room for."""
        return self.maxima.shape[0]

    def branch(self, table, field):
        """The branch on which a new field lies: (rising, index n of the first wiped pair, fixed threshold, M there).

        Rising, M(v) = M_b + 2 T(v, b) from the last minimum b below; falling, M(v) = M_a - 2 T(a, v).
        """
        rising = field >= self.field
        kept_up = jnp.sum(self.maxima > field)
        kept_down = jnp.sum(self.minima < field)
        return self.select(table, rising, jnp.where(rising, kept_up, kept_down))

    def select(self, table, rising, kept):
        """As `branch`, with the number of surviving pairs known; one less where a field falls from a maximum that came back to the one
        before to TOUCHED: a loop that only rounding leaves open would stay a corner more in every period of a steady drive."""
        kept = jnp.where(~rising & (kept > 0) & self._back(kept - 1), kept - 1, kept)
        last, here = jnp.maximum(kept - 1, 0), self._latest(kept)
        bottom = kept == 0
        b = jnp.where(bottom, jnp.minimum(table.low, self.minima[0]), self.minima[last])
        m_b = jnp.where(bottom, table.lowest, self.m_minima[last])
        threshold = jnp.where(rising, b, self.maxima[here])
        m_there = jnp.where(rising, m_b, self.m_maxima[here])
        return rising, kept, threshold, m_there

    def _back(self, k):
        """Whether maximum k + 1 came back to maximum k."""
        touched = TOUCHED * (jnp.abs(self.maxima[0]) + jnp.abs(self.minima[0]))
        there, after = (self.maxima[jnp.clip(n, 0, self.corners - 1)] for n in (k, k + 1))
        return after > there - touched

    def _latest(self, k):
        """The number of maximum k, or of the one that came back to it: of the two the field falls from the later one."""
        return jnp.minimum(jnp.where(self._back(k), k + 1, k), self.corners - 1)

    def move(self, rising, kept, field, magnetization) -> "Memory":
        """The memory after the field has reached `field` on the branch given by `branch` or `select`."""
        index = jnp.arange(self.corners)
        replace = index >= kept
        turn = index == kept
        latest = self._latest(kept)
        top, m_top = (jnp.where(rising, new, old[latest]) for new, old in ((field, self.maxima), (magnetization, self.m_maxima)))
        return Memory(
            maxima=jnp.where(turn, top, jnp.where(replace, field, self.maxima)),
            minima=jnp.where(replace, field, self.minima),
            m_maxima=jnp.where(turn, m_top, jnp.where(replace, magnetization, self.m_maxima)),
            m_minima=jnp.where(replace, magnetization, self.m_minima),
            field=field,
            magnetization=magnetization,
            overflow=self.overflow | (kept >= self.corners),
        )


def branch_magnetization(table, rising, threshold, m_there, field):
    """M on a branch: M_b + 2 T(v, b) rising, M_a - 2 T(a, v) falling."""
    alpha = jnp.where(rising, field, threshold)
    beta = jnp.where(rising, threshold, field)
    sign = jnp.where(rising, 2.0, -2.0)
    return m_there + sign * table(alpha, beta)


def saturated_memory(table, corners: int) -> Memory:
    """Every relay at -1, the field at the bottom of the plane."""
    low = jnp.broadcast_to(table.low, (corners,))
    m = jnp.broadcast_to(table.lowest, (corners,))
    return Memory(low, low, m, m, table.low, table.lowest, jnp.asarray(False))


def apply_field(table, memory: Memory, field) -> Memory:
    """Lead the field monotonically to a new value."""
    rising, kept, threshold, m_there = memory.branch(table, field)
    m = branch_magnetization(table, rising, threshold, m_there, field)
    return memory.move(rising, kept, field, m)


def start_history(start, low: float, high: float, alternations: int = 24) -> np.ndarray:
    """The alternating extrema that make a named start state, oldest first, A/m, after negative saturation.

    "negative_saturation" or "positive_saturation"; "demagnetized": a field that alternates about zero and decays in
    `alternations` equal steps, so that the memory curve is a fine staircase along alpha = -beta; or an array: a given
    history of fields. Raises `ConfigurationError` for other names.
    """
    if not isinstance(start, str):
        history = np.asarray(start, float).ravel()
    elif start in ("negative_saturation", "auto"):
        history = np.asarray([])
    elif start == "positive_saturation":
        history = np.asarray([high])
    elif start == "demagnetized":
        heights = max(abs(low), abs(high)) * (1 - np.arange(alternations) / alternations)
        history = np.append(np.clip(heights * (-1.0) ** np.arange(alternations), low, high), np.clip(0.0, low, high))
    else:
        raise ConfigurationError(
            f'start = "{start}" is no start state; write "demagnetized", "negative_saturation", "positive_saturation" or a history'
        )
    return np.asarray(wiped(np.append(low, history))[1:])


def memory_after(table, history, corners: int) -> Memory:
    """The memory after negative saturation and a reduced history of fields, (n,), A/m."""
    memory = saturated_memory(table, corners)
    for k in range(history.shape[0]):
        memory = apply_field(table, memory, history[k])
    return memory
