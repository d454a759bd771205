"""Is a column in the unit that it is said to be in? What no bench of this kind reaches, and what this bench reaches."""

import numpy as np

from .errors import RecordingError
from .words import sized

UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "current": {"A": 1.0, "mA": 1e-3},
    "command": {"A": 1.0, "mA": 1e-3},
    "field": {"A/m": 1.0, "A_per_m": 1.0, "kA/m": 1e3, "kA_per_m": 1e3, "Oe": 1e3 / (4 * np.pi)},
    "displacement": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "reference": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "flux_density": {"T": 1.0, "mT": 1e-3, "G": 1e-4},
    "magnetization": {"A/m": 1.0, "A_per_m": 1.0, "kA/m": 1e3, "kA_per_m": 1e3},
    "polarization": {"C/m^2": 1.0, "C_per_m2": 1.0, "C_per_m^2": 1.0, "uC/cm^2": 1e-2, "uC_per_cm2": 1e-2},
    "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "temperature": {"degC": 1.0, "K": 1.0},
    "strain": {"1": 1.0, "ppm": 1e-6},
    "stress": {"Pa": 1.0, "MPa": 1e6},
}
ZERO = {("temperature", "K"): -273.15}  # added after the factor
# quantity -> (largest absolute value that a bench of this kind gives, a usual one), SI
SENSIBLE = {
    "current": (60.0, 1.0), "displacement": (5e-3, 3e-5), "flux_density": (4.0, 1.0), "field": (5e6, 1e4), "voltage": (2e4, 100.0),
    "polarization": (3.0, 0.3),
}  # fmt: skip
STRONG_FIELD = 3e5  # A/m: several times what saturates a Terfenol-D rod


def si_unit(quantity: str) -> str:
    """The unit in which a quantity is held."""
    return next(iter(UNITS[quantity]))


def check_sizes(name: str, channels: dict, units: dict, bench):
    """Raise `RecordingError` where a channel, SI, is far beyond what benches give or what this bench file says, or far below.

    `units`: the unit in which each column is said to be, so that the mend names the one in which it would make sense.
    """

    for quantity, values in channels.items():
        if np.isinf(values).any():
            raise RecordingError(
                f"{name}: {quantity} is infinite at sample {int(np.argmax(np.isinf(values)))}; leave its cell empty, or record again"
            )

    def mend(quantity, value, usual):
        size = np.abs(channels[quantity])
        high = np.flatnonzero(size > 0.1 * np.nanmax(size))
        if len(high) <= max(3, len(size) // 1000):
            return f"only sample {high[0]} does: a spike; leave its cell empty, or record again"
        factors = {u: f for u, f in UNITS[quantity].items() if "/" not in u}
        said = units.get(quantity) or si_unit(quantity)
        read = value / UNITS[quantity][said]
        best = min(factors, key=lambda u: abs(np.log(read * factors[u] / usual)))
        if factors[best] == UNITS[quantity][said]:
            return f"check the column and the scale in [columns.{quantity}]"
        return f'if the column is in {best}, name it {quantity}_{best} or write unit = "{best}" in [columns.{quantity}]'

    drive, limit = bench.drive, bench.limit if bench.drive != "field" else None
    reach = bench.constants.get("magnetostriction.lambda_s", 0) * bench.constants.get("magnetostriction.l_rod", 0)
    reach = reach or bench.constants.get("piezo.stroke", 0)
    usual = (
        {q: v for q, (_, v) in SENSIBLE.items()}
        | ({drive: limit} if limit else {})
        | ({"displacement": reach / 3} if reach else {})
    )
    for quantity, (largest, _) in SENSIBLE.items():
        peak = float(np.nanmax(np.abs(channels[quantity]))) if quantity in channels else 0.0
        if peak > largest:
            raise RecordingError(
                f"{name}: {quantity} reaches {peak:.4g} {si_unit(quantity)}, more than any such bench gives; "
                f"{mend(quantity, peak, usual[quantity])}"
            )
    if limit and drive in channels:
        peak, unit = float(np.nanmax(np.abs(channels[drive]))), si_unit(drive)
        if peak > 20 * limit:
            raise RecordingError(
                f"{name}: the {drive} reaches {peak:.4g} {unit} where the bench allows {limit:g} {unit}; {mend(drive, peak, limit)}"
            )
    if reach and "displacement" in channels:
        what, at = ("stack", "V_m") if drive == "voltage" else ("rod", "saturation")
        stroke = float(np.nanmax(channels["displacement"]) - np.nanmin(channels["displacement"]))
        if stroke > 30 * reach or 0 < stroke < 1e-5 * reach:
            raise RecordingError(
                f"{name}: a stroke of {sized('m', stroke)} where the {what} gives {sized('m', reach)} at {at}; "
                f"{mend('displacement', stroke, usual['displacement'])}"
            )
