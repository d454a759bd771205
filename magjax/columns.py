"""Columns into quantities: which column of a table holds one, by the bench's map or by its name, and its values in SI."""

import re

import numpy as np

from .errors import ConfigurationError, RecordingError
from .plausibility import UNITS, ZERO

USUAL = {
    "current": "current_A", "displacement": "displacement_m", "field": "field_A_per_m", "strain": "strain_ppm", "time": "time_s",
    "reference": "reference_m", "voltage": "voltage_V", "polarization": "polarization_C_per_m2", "flux_density": "flux_density_T",
    "magnetization": "magnetization_A_per_m", "command": "command_A", "temperature": "temperature_degC", "stress": "stress_MPa",
}  # fmt: skip


def parse_name(name):
    """(quantity, unit) of a column name such as displacement_um; (None, None) where it is none."""
    name = name.replace("\u00b5", "u").replace("\u03bc", "u")
    for quantity, units in UNITS.items():
        match = re.fullmatch(rf"{quantity}(?:_(.+))?", name)
        if match:
            unit = match.group(1)
            if unit is None or unit in units:
                return quantity, unit
    return None, None


def column_of(path, table, quantity, column):
    """(name, unit) of a quantity's column, as mapped by the bench or by its name; (None, None) where there is none."""
    if "name" in column:
        return (column["name"], column.get("unit")) if column["name"] in table else (None, None)
    found = [n for n in table if parse_name(n)[0] == quantity]
    if len(found) > 1:
        raise RecordingError(
            f"{path}: columns {' and '.join(found)} both hold the {quantity}; say which in [columns.{quantity}] of the bench (name = ...)"
        )
    return (found[0], column.get("unit", parse_name(found[0])[1])) if found else (None, None)


def quantity_of(path, table, quantity, column, required):
    """A quantity's values in SI; None where there is no column and none is `required`. `column`: the bench's map of it.

    Raises `RecordingError` naming file, column and mend, and `ConfigurationError` for a unit that is not known.
    """
    name, unit = column_of(path, table, quantity, column)
    if name is None:
        if not required:
            return None
        if "name" in column:
            raise RecordingError(f"{path}: no column {column['name']}; the file has {', '.join(table)} (see [columns.{quantity}])")
        raise RecordingError(
            f"{path}: no {quantity} column among {', '.join(table)}; "
            f"name it {USUAL[quantity]} or map it in [columns.{quantity}] of the bench"
        )
    values, factor = np.asarray(table[name], float), 1.0
    if unit is not None and "emf_turns" not in column:
        if unit not in UNITS[quantity]:
            raise ConfigurationError(f'columns.{quantity}.unit = "{unit}" is unknown; write one of {", ".join(UNITS[quantity])}')
        factor = UNITS[quantity][unit]
    zero = ZERO.get((quantity, unit), 0.0)
    return (values * float(column.get("scale", 1.0)) + float(column.get("offset", 0.0))) * factor + zero
