"""Source: commanded current (A) -> coil current I (A). An ideal amplifier, the identity.

Left out: amplifier lag (effect amplifier_lag), voltage compliance (effect amplifier_clipping).
"""

import equinox as eqx


class Source(eqx.Module):
    """An ideal current source: the current is what was commanded."""

    def __call__(self, current):
        """Coil current from the command, both A."""
        return current
