"""The words and units of a bench: field and magnetization where a coil drives it, voltage and polarization on electrodes.

A piezo or ferroelectric stack has the same form as a magnetostrictive rod: its voltage plays the field H, its polarization
the magnetization M. The code keeps the rod's names; what is printed, drawn and written takes these.
"""

import dataclasses
import re

DRIVE_UNITS = {"current": "A", "field": "A/m", "voltage": "V"}
LIMITS = {"current": "current_A", "field": "field_A_per_m", "voltage": "voltage_V"}  # drive -> key of [limits]


@dataclasses.dataclass(frozen=True)
class Terms:
    """What plays H and M: `field` in `unit`, `applied` before any loss, `state` in `state_unit`; letters for axes."""

    field: str
    unit: str
    applied: str
    state: str
    state_unit: str
    field_letter: str
    state_letter: str

    def unit_of(self, unit: str) -> str:
        """The unit of what is declared for a rod in a coil."""
        return unit if self.unit == "A/m" else re.sub(r"\bA(/m)?\b", self.unit, unit)

    def word(self, signal: str) -> str:
        """A signal's name, underscores as spaces, as it is called here."""
        named = {} if self.unit == "A/m" else {"current": self.field, "field": self.field, "magnetization": self.state}
        return " ".join(named.get(w, w) for w in signal.split("_"))

    def scaled(self, largest: float, state: bool = False) -> tuple[float, str]:
        """(factor, unit) in which numbers up to `largest` are drawn: kA/m for large fields."""
        unit = self.state_unit if state else self.unit
        return (1e-3, "kA/m") if unit == "A/m" and largest > 2e3 else (1.0, unit)


MAGNETIC = Terms("field", "A/m", "applied field", "magnetization", "A/m", "H", "M")
ELECTRIC = Terms("voltage", "V", "voltage", "polarization", "V", "V", "P")


def terms_of(drive: str) -> Terms:
    """The terms of a bench by what drives it."""
    return ELECTRIC if drive == "voltage" else MAGNETIC
