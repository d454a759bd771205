"""What the material of an emulated bench remembers from one run to the next: the extrema of the field that still matter.

A steady loop between two fields has the same form whatever came before (congruency); the past only shifts its level, by the
relays that the loop never reaches. So the steady state is simulated from negative saturation and shifted, which is exact for any
number of corners; the first periods are simulated from the coarsest `MOST` corners, and shifted to meet the steady state.
"""

import numpy as np

from ..extrema import wiped
from ..inverse.operator import PlainPreisach

MOST = 16  # corners from which a transient is simulated: the number is fixed, so that one compiled program serves every run


class Material:
    """Masses (A/m), the plane from `low` to `high` (A/m), `rest`: the field without current; `past`: extrema, A/m, oldest first."""

    def __init__(self, masses, low: float, high: float, rest: float, past=()):
        self.operator = PlainPreisach(masses, low, high)
        self.rest = rest
        self.past = wiped([low, *np.clip(past, low, high)])

    def few(self) -> np.ndarray:
        """`MOST` fields that lead close to the present state: all corners where they are few, else pairs spread over them."""
        inner, low = self.past[1:], self.operator.low
        if len(inner) > MOST:
            start = len(inner) % 2  # the present field, and pairs before it
            pairs = np.asarray(inner[start:]).reshape(-1, 2)
            kept = np.unique(np.linspace(0, len(pairs) - 1, MOST // 2).round().astype(int))
            inner = pairs[kept].ravel()
        return np.concatenate([np.full(MOST - len(inner), low), inner])

    def level(self, history, lowest: float, highest: float) -> float:
        """How much higher M lies on the loop between two fields after a history than after negative saturation, A/m."""
        reached = []
        for past in (history, ()):
            operator = self.operator.copy()
            for field in (*past, highest, lowest, highest):
                operator.apply(float(field))
            reached.append(operator.magnetization)
        return reached[0] - reached[1]

    def start(self, history) -> float:
        """How much higher M starts after `past` than after `history`, A/m."""
        reached = []
        for past in (self.past, history):
            operator = self.operator.copy()
            for field in past:
                operator.apply(float(field))
            reached.append(operator.magnetization)
        return reached[0] - reached[1]

    def run(self, fields) -> None:
        """Remember a run's fields, A/m, and that the drive fell to zero behind it."""
        inside = np.clip([*fields, self.rest], self.operator.low, self.operator.high)
        self.past = wiped([*self.past, *inside])
