"""What `magjax invert` does: a wanted displacement in a file to the current (of a piezo stack the voltage) in a file."""

import contextlib
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError, RecordingError
from .dynamic import KNOWN_INVERSES, SENSOR_INVERSES, PlainActuator, current_for_displacement, nearest_feasible, undo_sensor
from .stack import KNOWN_INVERSES as STACK_INVERSES
from .stack import PlainStack, voltage_for_displacement

LONGEST_M = 5e-3  # no actuator of this kind moves further: the unit is wrong


def invert_file(trajectory, bench, model, out, of_reading: bool = False) -> dict:
    """Read time_s and displacement_m (or _um), write time_s and current_A; returns a summary.

    Where the wanted displacement is not feasible a third column, displacement_m, is the nearest feasible one that the
    current is for.
    """
    actuator, bench = load_actuator(bench, model)
    time, wanted = read_trajectory(Path(trajectory), bench.columns)
    h = float(np.median(np.diff(time)))
    if actuator.coil.drive == "voltage":
        return _invert_stack(actuator, trajectory, time, wanted, h, out, of_reading)
    plant = PlainActuator.from_actuator(actuator)
    current, infeasible, saturated = current_for_displacement(plant, wanted, h, of_reading)
    if infeasible.all():
        stroke = 1e6 * plant.l_rod * plant.lambda_s
        raise RecordingError(
            f"{trajectory}: no sample can be reached ({1e6 * wanted.min():.4g} .. {1e6 * wanted.max():.4g} um are wanted, "
            f"the actuator moves between 0 and {stroke:.4g} um); check unit and zero"
        )
    columns, names = [time, current], "time_s,current_A"
    if infeasible.any():
        columns.append(nearest_feasible(plant, undo_sensor(plant, wanted, h) if of_reading else wanted, h))
        names += ",displacement_m"
    write_table(out, columns, names)
    known = (*KNOWN_INVERSES, *(SENSOR_INVERSES if of_reading else ()))
    left = [e for e in plant.effects if e not in known]
    text = f"current {current.min():.4g} .. {current.max():.4g} A; wrote {out}"
    if infeasible.any():
        text += f"; {int(infeasible.sum())} samples were not feasible (0 <= u <= M_s^2) and the nearest was taken "
        text += f"(column displacement_m), first at t = {time[np.argmax(infeasible)]:.4g} s"
    if saturated.any():
        text += f"; {int(saturated.sum())} samples need a magnetization outside the fitted plane, "
        text += f"first at t = {time[np.argmax(saturated)]:.4g} s"
    if left:
        text += f"; not compensated: {', '.join(left)}"
    return {
        "file": str(out),
        "infeasible": int(infeasible.sum()),
        "saturated": int(saturated.sum()),
        "not_compensated": left,
        "message": text,
    }


def _invert_stack(actuator, trajectory, time, wanted, h, out, of_reading) -> dict:
    """`invert_file` for a piezo stack: writes time_s and voltage_V."""
    plant = PlainStack.from_actuator(actuator)
    voltage, beyond = voltage_for_displacement(plant, wanted, h, of_reading)
    if beyond.all():
        low, high = (1e6 * v for v in plant.range)
        raise RecordingError(
            f"{trajectory}: no sample can be reached ({1e6 * wanted.min():.4g} .. {1e6 * wanted.max():.4g} um are wanted, "
            f"the stack moves between {low:.4g} and {high:.4g} um); check unit and zero"
        )
    write_table(out, [time, voltage], "time_s,voltage_V")
    left = [e for e in plant.effects if e not in (*STACK_INVERSES, *(SENSOR_INVERSES if of_reading else ()))]
    text = f"voltage {voltage.min():.4g} .. {voltage.max():.4g} V; wrote {out}"
    if beyond.any():
        text += (
            f"; {int(beyond.sum())} samples need a voltage outside the fitted plane, first at t = {time[np.argmax(beyond)]:.4g} s"
        )
    if left:
        text += f"; not compensated: {', '.join(left)}"
    return {"file": str(out), "infeasible": 0, "saturated": int(beyond.sum()), "not_compensated": left, "message": text}


def write_table(out, columns, names: str) -> None:
    """Columns as CSV, whole or not at all; raises `ConfigurationError` where that cannot be."""
    out = Path(out)
    if out.is_dir():
        raise ConfigurationError(f"{out}: is a folder; give the name of a file in it")
    partial = out.with_name(out.name + ".part")
    try:
        np.savetxt(partial, np.stack(columns, axis=1), delimiter=",", header=names, comments="", fmt="%.12g")
        partial.replace(out)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise ConfigurationError(f"{out}: cannot be written ({error.strerror or error}); choose another --out") from None


def load_actuator(bench, model):
    """(actuator, bench) of a fitted result folder, else of a bench."""
    from ..cli.runtime import prepare_jax

    prepare_jax()
    if model:
        from ..model_file import load_model

        return load_model(model)
    from ..bench import load_bench

    bench = load_bench(bench or "aa-050h")
    return bench.actuator(), bench


def read_trajectory(path, columns=None):
    """(time, displacement) of a CSV, in SI; raises `RecordingError` naming what is missing.

    `columns`: a bench's column map; it holds for the columns that are there by its names, others go by the usual names.
    """
    from ..columns import USUAL, column_of, quantity_of
    from ..formats import read_csv

    if not path.exists():
        raise RecordingError(f"{path}: no such file; check the name")
    try:
        table, _ = read_csv(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise RecordingError(f"{path}: cannot be read as CSV ({reason}); give a table with time_s and displacement_m") from None
    found = []
    for quantity in ("time", "displacement"):
        mapped = (columns or {}).get(quantity, {})
        if mapped.get("name") not in table:
            mapped = {}
        if column_of(path, table, quantity, mapped)[0] is None:
            raise RecordingError(f"{path}: no {quantity} column among {', '.join(table)}; name it {USUAL[quantity]}")
        found.append(quantity_of(path, table, quantity, mapped, required=True))
    time, wanted = found
    steps = np.diff(time)
    if len(time) < 4 or not np.all(np.isfinite(wanted)) or not np.all(np.isfinite(time)):
        raise RecordingError(f"{path}: needs at least four samples and no gaps in time or displacement; fill or cut them")
    if not np.median(steps) > 0:
        raise RecordingError(f"{path}: time does not run forward (steps of {np.median(steps):.6g} s); sort the samples by time")
    if np.abs(wanted).max() > LONGEST_M:
        raise RecordingError(
            f"{path}: displacements up to {np.abs(wanted).max():.4g} m; if the column is in um, name it displacement_um"
        )
    uneven = np.abs(steps - np.median(steps)) > 1e-3 * abs(np.median(steps))
    if uneven.any():
        k = int(np.argmax(uneven))
        raise RecordingError(
            f"{path}: time is not uniform at sample {k + 1} (step {steps[k]:.6g} s, usually {np.median(steps):.6g}); resample it"
        )
    return time, wanted
