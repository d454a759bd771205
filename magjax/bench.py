"""The bench file (TOML): constants, which blocks there are, which column is which quantity, what is free.

A bench with [magnetostriction] and [mechanics] ends at displacement and is driven by current; one whose [coil] holds
k_eddy is driven by a known field and ends at flux density. With output = "strain" a table of strain curves is read, no recording.
"""

import dataclasses
import difflib
import tomllib
from pathlib import Path

from .errors import ConfigurationError

BLOCK_KEYS = {
    "coil": ("R_eddy", "c0", "H_bias", "N_m", "A_m", "k_eddy"),
    "magnetostriction": ("lambda_s", "M_s", "l_rod"),
    "mechanics": ("f0", "xi"),
    "sensor": ("offset", "tau", "order2"),
}
KNOWN_TO = 1e-3  # relative; how well a filter of the sensor that is stated is taken to be known
OTHER_KEYS = {
    "hysteresis": ("levels", "start"),
    "limits": ("current_A", "field_A_per_m"),
    "fit": ("free", "output", "priors"),
}
COLUMN_KEYS = (
    "name",
    "scale",
    "offset",
    "unit",
    "split",
    "merge",
    "quasistatic",
    "emf_turns",
    "emf_area",
    "emf_sign",
    "bits",
    "gain_accuracy",
)
QUANTITIES = (
    "time",
    "current",
    "command",
    "field",
    "displacement",
    "reference",
    "flux_density",
    "magnetization",
    "voltage",
    "temperature",
    "strain",
    "stress",
)
STARTS = ("auto", "demagnetized", "negative_saturation", "positive_saturation")


@dataclasses.dataclass(frozen=True)
class Bench:
    """What stands on the bench. `constants`: "block.parameter" -> SI; `columns`: quantity -> how a file names it."""

    name: str
    blocks: tuple[str, ...]
    constants: dict
    drive: str
    output: str
    columns: dict
    free: tuple[str, ...]
    levels: int
    start: str
    limits: dict
    priors: dict
    source: str = ""

    def actuator(self):
        """The actuator with these constants and a starting density (imports JAX)."""
        from .actuator import from_bench

        return from_bench(self)


def built_in_benches() -> dict[str, Path]:
    """Name -> file of the benches that come with magjax."""
    return {p.stem: p for p in sorted((Path(__file__).parent / "benches").glob("*.toml"))}


def load_bench(bench) -> Bench:
    """A bench by built-in name, by TOML path, or as it is.

    Raises `ConfigurationError` naming the file, the key and the mend.
    """
    if isinstance(bench, Bench):
        return bench
    path = built_in_benches().get(str(bench), Path(str(bench)))
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        names = ", ".join(built_in_benches())
        raise ConfigurationError(f"bench {bench}: {error.strerror or error}; give a TOML file or one of {names}") from None
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"bench {path}: not valid TOML ({error})") from None
    return _build(content, path)


def _suggest(key, known):
    close = difflib.get_close_matches(key, known, 1)
    return f'; did you mean "{close[0]}"?' if close else f"; known are {', '.join(known)}"


def _check_keys(content, path):
    sections = {**BLOCK_KEYS, **OTHER_KEYS}
    for key, value in content.items():
        if key == "name":
            continue
        if key == "columns":
            for quantity, column in value.items():
                if quantity not in QUANTITIES:
                    raise ConfigurationError(f"bench {path}: [columns.{quantity}] is unknown{_suggest(quantity, QUANTITIES)}")
                for inner in column:
                    if inner not in COLUMN_KEYS:
                        raise ConfigurationError(
                            f"bench {path}: columns.{quantity}.{inner} is unknown{_suggest(inner, COLUMN_KEYS)}"
                        )
            continue
        if key not in sections:
            raise ConfigurationError(f"bench {path}: [{key}] is unknown{_suggest(key, (*sections, 'columns', 'name'))}")
        if not isinstance(value, dict):
            raise ConfigurationError(f"bench {path}: {key} must be a section, written [{key}]")
        for inner in value:
            if inner not in sections[key]:
                raise ConfigurationError(f"bench {path}: {key}.{inner} is unknown{_suggest(inner, sections[key])}")


def _build(content, path) -> Bench:
    _check_keys(content, path)
    constants = {}
    for block, keys in BLOCK_KEYS.items():
        for key in keys:
            if key in content.get(block, {}):
                value = content[block][key]
                if isinstance(value, bool) or not isinstance(value, (int, float)):
                    raise ConfigurationError(f"bench {path}: {block}.{key} = {value!r} must be a number")
                if value < 0 and key not in ("H_bias", "offset"):
                    raise ConfigurationError(f"bench {path}: {block}.{key} = {value} is negative; give a value of zero or more")
                if value == 0 and key not in ("H_bias", "offset", "k_eddy", "xi", "order2"):
                    raise ConfigurationError(f"bench {path}: {block}.{key} = 0; give a positive value")
                constants[f"{block}.{key}"] = float(value)
    drive = "field" if "coil.k_eddy" in constants else "current"
    present = tuple(
        b for b in ("source", "coil", "hysteresis", "magnetostriction", "mechanics", "sensor")
        if b in ("source", "coil", "hysteresis", "sensor") or b in content
    )  # fmt: skip
    fit = content.get("fit", {})
    output = fit.get("output", "displacement" if "magnetostriction" in present else "flux_density")
    lag = "coil.k_eddy" if drive == "field" else "coil.R_eddy"
    free = tuple(fit.get("free", ("hysteresis.masses", lag, *(("mechanics.xi", "mechanics.f0") if "mechanics" in present else ()))))
    hysteresis = content.get("hysteresis", {})
    levels, start = hysteresis.get("levels", 25), hysteresis.get("start", "auto")
    if not isinstance(levels, int) or not 2 <= levels <= 400:
        raise ConfigurationError(f"bench {path}: hysteresis.levels = {levels!r}; give a whole number from 2 to 400")
    if start not in STARTS:
        raise ConfigurationError(f'bench {path}: hysteresis.start = "{start}" is unknown{_suggest(str(start), STARTS)}')
    known_free = ("hysteresis.masses", "sensor.offset", *(f"{b}.{k}" for b, ks in BLOCK_KEYS.items() for k in ks))
    for name in free:
        if name not in known_free:
            raise ConfigurationError(f'bench {path}: fit.free names "{name}"{_suggest(str(name), known_free)}')
    for quantity, column in content.get("columns", {}).items():
        for key, top in (("bits", 32), ("gain_accuracy", 0.5)):
            value = column.get(key, 1)
            if key in column and (isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= top):
                raise ConfigurationError(
                    f"bench {path}: columns.{quantity}.{key} = {value!r}; give a number above 0 and up to {top}"
                )
    priors = {str(k): float(v) for k, v in fit.get("priors", {}).items()}
    if "sensor.order2" in constants and "sensor.tau" not in constants:
        raise ConfigurationError(f"bench {path}: sensor.order2 without sensor.tau; state the filter's tau in s beside it")
    if "sensor.tau" in constants:
        for key, least in (("tau", 1e-9), ("order2", 1e-3)):
            priors.setdefault(f"effects.sensor_lag.{key}", max(KNOWN_TO * constants.get(f"sensor.{key}", 0.0), least))
    return Bench(
        content.get("name", path.stem), present, constants, drive, output, content.get("columns", {}), free,
        levels, start, content.get("limits", {}), priors, str(path),
    )  # fmt: skip
