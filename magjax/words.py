"""Sizes in words: in the prefix of their unit that suits them."""

import math

PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
PREFIXED = ("m", "s", "A", "V", "T", "Hz", "Pa")


def sized(unit: str, *values: float, digits: int = 3, joined: str = " -> ") -> str:
    """Values of one quantity, SI, by the prefix of the largest: ("m", 1.2e-7, 4.7e-8) is "120 -> 47 nm"; units of no prefix stay."""
    largest = max((abs(float(v)) for v in values if math.isfinite(v)), default=0.0)
    prefix, factor = "", 1.0
    if unit in PREFIXED and largest > 0:
        rounded = float(f"{largest:.{digits}g}")
        prefix, factor = next(((p, f) for p, f in PREFIXES.items() if rounded >= f), ("p", 1e-12))
    told = joined.join(_plain(v / factor, digits) if unit in PREFIXED else f"{v / factor:.{digits}g}" for v in values)
    return told if unit in ("", "1") else f"{told} {prefix}{unit}"


def _plain(value: float, digits: int) -> str:
    """A value to so many digits, without a power of ten where it has more of them before the point: 1.4e+02 is 140."""
    rounded = f"{value:.{digits}g}"
    return f"{float(rounded):.0f}" if "e+" in rounded and abs(value) < 1e6 else rounded
