"""The bench file (TOML): constants, which blocks there are, which column is which quantity, what is free.

A bench with [magnetostriction] and [mechanics] ends at displacement and is driven by current; one whose [coil] holds
k_eddy is driven by a known field and ends at flux density; one with [piezo] is driven by a voltage and ends at displacement
or polarization. With output = "strain" a table of strain curves is read, no recording.
"""

import dataclasses
import difflib
import sys
import tomllib
from pathlib import Path

from .errors import ConfigurationError
from .terms import LIMITS, Terms, terms_of

BLOCK_KEYS = {
    "coil": ("R_eddy", "c0", "H_bias", "N_m", "A_m", "k_eddy"),
    "magnetostriction": ("lambda_s", "M_s", "l_rod"),
    "piezo": ("stroke", "P_m", "V_m", "chi"),
    "mechanics": ("f0", "xi"),
    "sensor": ("offset", "tau", "order2"),
}
KNOWN_TO = 1e-3  # relative; how well a filter of the sensor that is stated is taken to be known
OTHER_KEYS = {
    "hysteresis": ("levels", "start"),
    "limits": tuple(LIMITS.values()),
    "fit": ("free", "output", "priors"),
}
NEEDED = {  # what a block should state: else T&B's constant is taken for this bench's, which is told
    "coil": ("R_eddy", "c0", "H_bias", "N_m", "A_m"),
    "magnetostriction": BLOCK_KEYS["magnetostriction"],
    "mechanics": BLOCK_KEYS["mechanics"],
}
SIGNED = ("H_bias", "offset")
MAY_BE_ZERO = (*SIGNED, "k_eddy", "xi", "order2", "chi")
COLUMN_KEYS = {  # key -> what it must be
    "name": str,
    "scale": float,
    "offset": float,
    "unit": str,
    "split": str,
    "merge": bool,
    "quasistatic": bool,
    "emf_turns": float,
    "emf_area": float,
    "emf_sign": float,
    "bits": float,
    "gain_accuracy": float,
}
LARGEST = {"bits": 32, "gain_accuracy": 0.5}  # of those column keys that lie above zero and are bounded
QUANTITIES = (
    "time",
    "current",
    "command",
    "field",
    "displacement",
    "reference",
    "flux_density",
    "magnetization",
    "polarization",
    "voltage",
    "temperature",
    "strain",
    "stress",
)
OUTPUTS = ("displacement", "flux_density", "magnetization", "polarization", "strain")
STARTS = ("auto", "demagnetized", "negative_saturation", "positive_saturation")


@dataclasses.dataclass(frozen=True)
class Bench:
    """What stands on the bench. `constants`: "block.parameter" -> SI; `columns`: quantity -> how a file names it;
    `start`: the state before the drive by name, or the fields, A/m, that led to it from negative saturation, oldest first."""

    name: str
    blocks: tuple[str, ...]
    constants: dict
    drive: str
    output: str
    columns: dict
    free: tuple[str, ...]
    levels: int
    start: str | tuple[float, ...]
    limits: dict
    priors: dict
    source: str = ""

    @property
    def assumed(self) -> tuple[str, ...]:
        """Constants that the file does not state: those of T&B Sec. 2.3 (`aa-050h`) stand in for them."""
        needed = [f"{block}.{key}" for block, keys in NEEDED.items() if block in self.blocks for key in keys]
        if self.drive != "current":
            needed = [name for name in needed if not name.startswith("coil.")]
        return () if self.output == "strain" else tuple(name for name in needed if name not in self.constants)

    @property
    def terms(self) -> Terms:
        """The words and units in which this bench is spoken of."""
        return terms_of(self.drive)

    @property
    def quasistatic(self) -> bool:
        """Whether its loops are given as points, with no time."""
        return bool(self.columns.get("time", {}).get("quasistatic"))

    @property
    def limit(self) -> float | None:
        """Largest drive that [limits] states, SI."""
        return self.limits.get(LIMITS[self.drive])

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
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"bench {path}: not text in UTF-8 (byte {error.start + 1}); save it again as UTF-8") from None
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
        if key not in sections and key != "columns":
            raise ConfigurationError(f"bench {path}: [{key}] is unknown{_suggest(key, (*sections, 'columns', 'name'))}")
        if not isinstance(value, dict):
            wanted = "[columns.QUANTITY], for instance [columns.displacement]" if key == "columns" else f"[{key}]"
            raise ConfigurationError(f"bench {path}: {key} = {value!r} must be a section, written {wanted}")
        for inner in value:
            if key == "columns" and inner not in QUANTITIES:
                raise ConfigurationError(f"bench {path}: [columns.{inner}] is unknown{_suggest(inner, QUANTITIES)}")
            if key != "columns" and inner not in sections[key]:
                raise ConfigurationError(f"bench {path}: {key}.{inner} is unknown{_suggest(inner, sections[key])}")


def _number(value, where, path) -> float:
    """A finite number, or the error that names `where` it stands."""
    finite = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max  # nor is NaN
    if not finite:
        raise ConfigurationError(f"bench {path}: {where} = {value!r} must be a finite number, for instance {where} = 1.5")
    return float(value)


def _positive(value, where, path) -> float:
    if not _number(value, where, path) > 0:
        raise ConfigurationError(f"bench {path}: {where} = {value}; give a positive value")
    return float(value)


def _constants(content, path) -> dict:
    """ "block.parameter" -> SI, of the blocks that the file holds."""
    constants = {}
    for block, keys in BLOCK_KEYS.items():
        for key in (k for k in keys if k in content.get(block, {})):
            value = _number(content[block][key], f"{block}.{key}", path)
            if value < 0 and key not in SIGNED:
                raise ConfigurationError(f"bench {path}: {block}.{key} = {value:g} is negative; give a value of zero or more")
            if value == 0 and key not in MAY_BE_ZERO:
                raise ConfigurationError(f"bench {path}: {block}.{key} = 0; give a positive value")
            constants[f"{block}.{key}"] = value
    return constants


def _check_blocks(content, path):
    """What is stated fits together."""
    coil = content.get("coil", {})
    if "k_eddy" in coil and "R_eddy" in coil:
        raise ConfigurationError(
            f"bench {path}: coil.R_eddy does nothing beside coil.k_eddy, which says that the drive is a known field; take one away"
        )
    if "piezo" in content:
        _check_piezo(content, path)
    elif "mechanics" in content and "magnetostriction" not in content:
        raise ConfigurationError(f"bench {path}: [mechanics] without [magnetostriction], which drives it; add that block")
    sensor = content.get("sensor", {})
    if "order2" in sensor and "tau" not in sensor:
        raise ConfigurationError(f"bench {path}: sensor.order2 without sensor.tau; state the filter's tau in s beside it")


def _check_piezo(content, path):
    """A stack under voltage has no coil, and its data sheet's stroke where a displacement is read."""
    for block in ("coil", "magnetostriction"):
        if block in content:
            raise ConfigurationError(f"bench {path}: [{block}] beside [piezo], which is driven by a voltage; take one away")
    charge = content.get("fit", {}).get("output") == "polarization"
    scale, what = ("P_m", "largest polarization P_m (C/m^2)") if charge else ("stroke", "data sheet's stroke (m)")
    missing = [k for k in (scale, "V_m") if k not in content["piezo"]]
    if missing:
        raise ConfigurationError(
            f"bench {path}: [piezo] does not state {' and '.join(missing)}; write the {what} and the voltage V_m (V) it belongs to"
        )
    if charge and "mechanics" in content:
        raise ConfigurationError(f'bench {path}: [mechanics] moves nothing where fit.output = "polarization"; take it away')


def _columns(content, path) -> dict:
    """[columns] as it stands, every key of the kind that readers expect."""
    columns = content.get("columns", {})
    words = {str: 'text, written in quotes ("...")', bool: "true or false"}
    for quantity, column in columns.items():
        where = f"columns.{quantity}"
        if not isinstance(column, dict):
            raise ConfigurationError(f'bench {path}: {where} = {column!r} must be a section: [{where}] with name = "..." under it')
        for key, value in column.items():
            if key not in COLUMN_KEYS:
                raise ConfigurationError(f"bench {path}: {where}.{key} is unknown{_suggest(key, tuple(COLUMN_KEYS))}")
            if COLUMN_KEYS[key] is not float and not isinstance(value, COLUMN_KEYS[key]):
                raise ConfigurationError(f"bench {path}: {where}.{key} = {value!r} must be {words[COLUMN_KEYS[key]]}")
            if key in LARGEST and not (type(value) in (int, float) and 0 < value <= LARGEST[key]):
                raise ConfigurationError(f"bench {path}: {where}.{key} = {value!r}; give a number above 0 and up to {LARGEST[key]}")
            if COLUMN_KEYS[key] is float:
                (_positive if key in ("emf_turns", "emf_area") else _number)(value, f"{where}.{key}", path)
        if column.get("scale", 1) == 0:
            raise ConfigurationError(f"bench {path}: {where}.scale = 0 leaves nothing of the column; give reading over column")
        if column.get("emf_sign", 1) not in (-1, 1):
            raise ConfigurationError(f"bench {path}: {where}.emf_sign = {column['emf_sign']}; give 1 or -1")
        emf = {"emf_turns", "emf_area"}
        if any(k.startswith("emf_") for k in column) and not emf <= set(column):
            raise ConfigurationError(
                f"bench {path}: [{where}] has no {sorted(emf - set(column))[0]}; a pick-up coil needs both emf_turns and emf_area (m^2)"
            )
    return columns


LEAST_LIMIT = 1e-6  # A, A/m or V: no source is as small


def _limits(content, path, drive) -> dict:
    limits = content.get("limits", {})
    for key, value in limits.items():
        if _positive(value, f"limits.{key}", path) < LEAST_LIMIT:
            raise ConfigurationError(f"bench {path}: limits.{key} = {value:g} drives nothing; give the largest that the source puts out, in the unit of the key")
    for other, key in LIMITS.items():
        if key in limits and other != drive and LIMITS[drive] not in limits:
            raise ConfigurationError(f"bench {path}: limits.{key} bounds a bench driven by a {other}; give limits.{LIMITS[drive]}")
    return limits


def _start(content, path):
    """hysteresis.start: a name, or the fields that led there."""
    start = content.get("hysteresis", {}).get("start", "auto")
    if isinstance(start, list):
        return tuple(_number(v, f"hysteresis.start[{k}]", path) for k, v in enumerate(start))
    if start not in STARTS:
        raise ConfigurationError(
            f"bench {path}: hysteresis.start = {start!r} is unknown{_suggest(str(start), STARTS)}, or a list of fields in A/m"
        )
    return start


def _fit(content, path, present, drive):
    """(free, output, priors) of [fit]."""
    fit = content.get("fit", {})
    lag = {"field": "coil.k_eddy", "current": "coil.R_eddy", "voltage": "piezo.chi"}[drive]
    free = fit.get("free", ["hysteresis.masses", lag, *(("mechanics.xi", "mechanics.f0") if "mechanics" in present else ())])
    if not isinstance(free, list):
        written = f'["{free}"]' if isinstance(free, str) else '["coil.R_eddy"]'
        raise ConfigurationError(f"bench {path}: fit.free = {free!r} must be a list; write free = {written}")
    known = ("hysteresis.masses", *(f"{b}.{k}" for b, ks in BLOCK_KEYS.items() for k in ks))
    for name in free:
        if name not in known:
            raise ConfigurationError(f'bench {path}: fit.free names "{name}"{_suggest(str(name), known)}')
    moves = "magnetostriction" in present or drive == "voltage"
    output = fit.get("output", "displacement" if moves else "flux_density")
    if output not in OUTPUTS:
        raise ConfigurationError(f"bench {path}: fit.output = {output!r} is unknown{_suggest(str(output), OUTPUTS)}")
    if drive == "voltage" and output not in ("displacement", "polarization"):
        raise ConfigurationError(
            f'bench {path}: fit.output = "{output}" is not read of a stack under voltage; write "displacement" or "polarization"'
        )
    if output == "polarization" and drive != "voltage":
        raise ConfigurationError(f'bench {path}: fit.output = "polarization" needs [piezo]; write "magnetization" for a rod')
    driven = [block for block in ("coil", "piezo") if block in content]
    if output == "strain" and driven:
        raise ConfigurationError(
            f'bench {path}: fit.output = "strain" reads a table of strain curves, which nothing drives; take [{driven[0]}] away, or write "displacement"'
        )
    if output == "displacement" and not moves:
        raise ConfigurationError(
            f'bench {path}: fit.output = "displacement" needs [magnetostriction]; add it or write "flux_density"'
        )
    return tuple(free), output, _priors(fit, path)


def _priors(fit, path) -> dict:
    """fit.priors: full name -> standard deviation, SI. The parameters of effects are known to the actuator (`from_bench`)."""
    stated = fit.get("priors", {})
    if not isinstance(stated, dict):
        raise ConfigurationError(f'bench {path}: fit.priors = {stated!r} must be a section: [fit.priors] with "coil.R_eddy" = 2.0')
    known = tuple(f"{b}.{k}" for b, ks in BLOCK_KEYS.items() for k in ks)
    priors = dict(_by_full_name(stated))
    for name, value in priors.items():
        if name not in known and not (name.startswith("effects.") and name.count(".") == 2):
            raise ConfigurationError(f'bench {path}: fit.priors names "{name}"{_suggest(name, known)}')
        priors[name] = _positive(value, f'fit.priors."{name}"', path)
    return priors


def _by_full_name(table, prefix=""):
    """TOML takes coil.R_eddy = 2.0, written without quotes, for a table in a table."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _by_full_name(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _build(content, path) -> Bench:
    _check_keys(content, path)
    name = content.get("name", path.stem)
    if not isinstance(name, str):
        raise ConfigurationError(f'bench {path}: name = {name!r} must be text; write name = "{name}"')
    constants = _constants(content, path)
    drive = "voltage" if "piezo" in content else "field" if "coil.k_eddy" in constants else "current"
    present = tuple(
        b for b in ("source", "coil", "hysteresis", "magnetostriction", "piezo", "mechanics", "sensor")
        if b in ("source", "hysteresis", "sensor") or b in content or (b == "coil" and drive != "voltage")
    )  # fmt: skip
    free, output, priors = _fit(content, path, present, drive)
    levels = content.get("hysteresis", {}).get("levels", 25)
    if not isinstance(levels, int) or not 2 <= levels <= 400:
        raise ConfigurationError(f"bench {path}: hysteresis.levels = {levels!r}; give a whole number from 2 to 400")
    start = _start(content, path)
    columns, limits = _columns(content, path), _limits(content, path, drive)
    _check_blocks(content, path)
    if "sensor.tau" in constants:
        for key, least in (("tau", 1e-9), ("order2", 1e-3)):
            priors.setdefault(f"effects.sensor_lag.{key}", max(KNOWN_TO * constants.get(f"sensor.{key}", 0.0), least))
    return Bench(name, present, constants, drive, output, columns, free, levels, start, limits, priors, str(path))
