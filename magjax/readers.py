"""Files into recordings: CSV, NetCDF, MATLAB, acquisition logs; units, column maps, an emf into flux density."""

import hashlib
import re
from pathlib import Path

import numpy as np

from .bench import load_bench
from .clipping import refuse_clipping
from .errors import ConfigurationError, MagjaxError, RecordingError
from .pickup import bridge_gaps, integrate_emf, merge_captures
from .plausibility import UNITS, ZERO, check_sizes
from .recording import BYSTANDERS, Recording, refuse_constant

SPELLED = {
    "ampere": "A", "amperes": "A", "amp": "A", "metre": "m", "meter": "m", "metres": "m", "meters": "m", "second": "s", "seconds": "s",
    "sec": "s", "millisecond": "ms", "milliseconds": "ms", "micrometre": "um", "micrometer": "um", "micron": "um", "millimetre": "mm",
    "millimeter": "mm", "tesla": "T", "volt": "V", "volts": "V",
}  # fmt: skip
USUAL = {
    "current": "current_A", "displacement": "displacement_m", "field": "field_A_per_m", "strain": "strain_ppm", "time": "time_s",
    "reference": "reference_m", "voltage": "voltage_V", "polarization": "polarization_C_per_m2", "flux_density": "flux_density_T",
    "magnetization": "magnetization_A_per_m", "command": "command_A", "temperature": "temperature_degC", "stress": "stress_MPa",
}  # fmt: skip
TEXT = (".csv", ".txt", ".dat", ".tsv", "")  # read as CSV


def load_recordings(paths, bench) -> list[Recording]:
    """Recordings of one or several files, SI, as the bench names their columns.

    Raises `RecordingError` naming file, column and mend.
    """
    bench = load_bench(bench)
    if bench.output == "strain":
        raise ConfigurationError('fit.output = "strain" reads a table of strain curves, no recording: give it to magjax diagnose')
    paths = [paths] if isinstance(paths, (str, Path)) else list(paths)
    if not paths:
        raise ConfigurationError("no recording given; name one or several files")
    recordings = []
    for path in paths:
        recordings += read_file(Path(path), bench)
    return recordings


def load_sound(paths, bench) -> tuple[list[Recording], list[RecordingError]]:
    """The recordings that can be used, and the error of each file that cannot."""
    recordings, errors = [], []
    for path in paths:
        try:
            recordings += load_recordings([path], bench)
        except RecordingError as error:
            errors.append(error)
    return recordings, errors


def load_checks(paths, bench) -> tuple[list[Recording], tuple[str, ...]]:
    """Recordings to check against, and a sentence for each that cannot be used: no fit needs them, so they end none.

    Raises `RecordingError` where a file does not exist.
    """
    recordings, refused = [], []
    for path in map(Path, paths):
        try:
            recordings += load_recordings([path], bench)
        except RecordingError as error:
            if not path.exists():
                raise
            refused.append(str(error))
    return recordings, tuple(refused)


def load_calibrations(paths, bench) -> list[Recording]:
    """Calibrations of the sensor: time, `reference` (the known displacement, m, by a reference sensor) and the reading.

    Any periodic motion of the sensor, without a coil current. Raises `RecordingError` naming file, column and mend.
    """
    bench = load_bench(bench)
    found = []
    for path in map(Path, paths):
        origin = {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} if path.is_file() else {}
        for table, metadata in _read_table(path):
            wanted = ("time", "reference", bench.output)
            columns = {q: _find(path, table, q, bench.columns.get(q, {}), required=True) for q in wanted}
            refuse_constant(path.name, bench.output, columns[bench.output])
            time, channels, _ = bridge_gaps(columns["time"] - columns["time"][0], {q: columns[q] for q in wanted[1:]}, "reference")
            found.append(
                Recording(time, channels, {}, {**origin, "metadata": {k: _number(v) for k, v in metadata.items()}}, path.name)
            )
    return found


def refuse_absent_and_twice(recordings, checks=(), more=()) -> None:
    """Raise `RecordingError` where a file is not there, and `ConfigurationError` where one is given twice, as a recording or to
    check: it would count twice, or check nothing."""
    seen = {}
    for path, what in (
        *((p, "recording") for p in recordings),
        *((p, "check") for p in checks),
        *((p, "calibration") for p in more),
    ):
        path = Path(path)
        if not path.exists():
            raise RecordingError(f"{path}: no such file; check the name")
        if not path.is_file() or what == "calibration":
            continue
        content = hashlib.sha256(path.read_bytes()).digest()
        if content in seen:
            other, before = seen[content]
            same = "is given twice" if other.resolve() == path.resolve() else f"holds the same as {other}"
            counts = "a check that is also fitted checks nothing" if before != what else "it would count twice"
            raise ConfigurationError(f"{path}: {same}; {counts}: leave one out")
        seen[content] = path, what


def read_columns(path: Path, bench, quantities) -> dict:
    """Columns of one table as they stand, without a time axis: quantity -> values in SI, for those that it holds."""
    table, _ = _read_table(Path(path))[0]
    found = {q: _find(path, table, q, bench.columns.get(q, {}), required=q == bench.output) for q in quantities}
    return {q: v for q, v in found.items() if v is not None}


def read_file(path: Path, bench) -> list[Recording]:
    """All recordings in one file."""
    tables = _read_table(path)
    origin = {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return [r for table, metadata in tables for r in _recordings(path, table, {**origin, "metadata": metadata}, bench)]


def _read_table(path: Path) -> list:
    """(columns, metadata) of every table in a file; one line says what is wrong with it."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file; check the name")
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; name its files (for instance {path}/*.csv)")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record again")
    suffix = path.suffix.lower()
    readers = {".nc": _read_netcdf, ".mat": _read_mat, ".mjlog": _read_log} | dict.fromkeys(TEXT, _read_csv)
    if suffix not in readers:
        raise RecordingError(
            f"{path}: files ending in {suffix} are not read; give {', '.join(s for s in readers if s)} (magjax export writes .nc, .csv, .mat)"
        )
    reader = readers[suffix]
    try:
        return reader(path) if suffix == ".mjlog" else [reader(path)]
    except MagjaxError:
        raise
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: is no text in UTF-8; save it again as CSV in UTF-8") from None
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise RecordingError(f"{path}: cannot be read as {suffix[1:] or 'CSV'} ({error}); save it again, or as CSV") from None


def _read_csv(path):
    metadata, skip = {}, 0
    with open(path, encoding="utf-8-sig") as stream:
        for line in stream:
            if not line.strip():
                skip += 1
                continue
            if not line.startswith("#"):
                header = line
                break
            key, _, value = line[1:].partition(":")
            metadata[key.strip()] = value.strip()
            skip += 1
        else:
            raise RecordingError(f"{path}: holds no header row; the first row must name the columns")
    separator = next((s for s in (",", ";", "\t") if s in header), ",")
    names = [n.strip().strip('"') for n in header.split(separator)]
    if not _has_rows(path, skip + 1):
        raise RecordingError(f"{path}: has a header but no samples; record again")
    try:
        values = _numbers(path, separator, skip + 1)
    except ValueError as error:
        raise RecordingError(f"{path}: rows of unequal length ({str(error).splitlines()[-1].strip()}); mend or cut them") from None
    if values.size == 0:
        raise RecordingError(f"{path}: has a header but no samples; record again")
    if twice := [n for n in dict.fromkeys(names) if names.count(n) > 1]:
        raise RecordingError(f"{path}: two columns are named {twice[0]}; rename or remove one")
    if values.shape[1] != len(names):
        raise RecordingError(f"{path}: {len(names)} column names but {values.shape[1]} columns; mend the header row")
    return dict(zip(names, values.T, strict=True)), metadata


def _numbers(path, separator, skip):
    """The rows of numbers: by the fast reader, or by the patient one, which takes empty cells for NaN and decimal commas."""
    try:
        return np.loadtxt(path, delimiter=separator, skiprows=skip, ndmin=2, comments="#", encoding="utf-8-sig")
    except ValueError:
        with open(path, encoding="utf-8-sig") as stream:
            lines = [line.partition("#")[0] for line in stream]
        if separator != ",":
            lines = [line.replace(",", ".") for line in lines]
        _refuse_words(path, lines, separator, skip)
        return np.genfromtxt(lines, delimiter=separator, skip_header=skip, ndmin=2, comments="#")


def _refuse_words(path, lines, separator, skip):
    """Raise `RecordingError` at the first cell that holds something else than a number."""
    for k, line in enumerate(lines[skip:], skip + 1):
        for cell in line.split(separator) if line.strip() else ():
            try:
                float(cell.strip().strip('"') or "nan")
            except ValueError:
                raise RecordingError(
                    f'{path}: line {k} holds "{cell.strip()[:30]}", which is no number; one header row, then numbers (put # before other lines)'
                ) from None


def _has_rows(path, skip) -> bool:
    """Whether any line after the first `skip` holds something."""
    with open(path, encoding="utf-8-sig") as stream:
        return any(line.strip() for k, line in enumerate(stream) if k >= skip)


def _read_netcdf(path):
    import xarray as xr

    with open(path, "rb") as stream:
        engine = "scipy" if stream.read(3) == b"CDF" else "h5netcdf"  # the classic format
    with xr.open_dataset(path, engine=engine) as data:
        table = {}
        for name in [*data.coords, *data.data_vars]:
            values, unit = data[name].values, str(data[name].attrs.get("units", ""))
            if np.ndim(values) != 1 or values.dtype.kind not in "fiubmM":
                continue
            if values.dtype.kind in "mM":  # decoded by its unit: an instant, or a span
                values, unit = (
                    (values - (values[0] if values.dtype.kind == "M" else np.timedelta64(0, "s"))) / np.timedelta64(1, "s"),
                    "s",
                )
            unit = SPELLED.get(unit.strip().lower(), unit.replace("\u00b5", "u").replace("\u03bc", "u"))
            key = name if _parse(name)[0] and _parse(name)[1] else f"{name}_{unit}".replace("/", "_per_").rstrip("_")
            table[key] = np.asarray(values, float)
        return table, {k: v for k, v in data.attrs.items()}


def _read_mat(path):
    import h5py

    if h5py.is_hdf5(path):  # v7.3
        with h5py.File(path) as file:
            content = {k: v[()] for k, v in file.items() if hasattr(v, "shape") and v.dtype.kind in "fiub"}
            content = {k: np.ravel(v) for k, v in content.items() if max(np.shape(v), default=0) == np.size(v)}
    else:
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError

        try:
            content = loadmat(path, squeeze_me=True)
        except (MatReadError, IndexError) as error:
            raise RecordingError(f"{path}: not a MATLAB file ({error}); save it again, or export it as CSV") from None
    kept = {k: np.asarray(v) for k, v in content.items() if not k.startswith("__") and np.ndim(v) == 1 and np.size(v)}
    table = {k: v.astype(float) for k, v in kept.items() if v.dtype.kind in "fiub"}
    if not table:
        held = ", ".join(k for k in content if not k.startswith("__")) or "nothing"
        raise RecordingError(
            f"{path}: holds no vector of numbers ({held}); save time, drive and reading as vectors, not in a struct"
        )
    return table, {}


def _read_log(path):
    """Every segment of a raw acquisition log: (table, metadata)."""
    from .acquire.log import read_log

    return read_log(path)


def _parse(name):
    """(quantity, unit) of a column name such as displacement_um; (None, None) where it is none."""
    name = name.replace("\u00b5", "u").replace("\u03bc", "u")
    for quantity, units in UNITS.items():
        match = re.fullmatch(rf"{quantity}(?:_(.+))?", name)
        if match:
            unit = match.group(1)
            if unit is None or unit in units:
                return quantity, unit
    return None, None


def _recordings(path, table, origin, bench) -> list[Recording]:
    split = bench.columns.get("time", {}).get("split")
    columns, units, available = {}, {}, list(table)
    _refuse_missing(path, table, bench)
    for quantity in (
        "time",
        "voltage",
        "temperature",
        "magnetization",
        "polarization",
        "flux_density",
        "displacement",
        "current",
        "command",
        "field",
    ):
        column = bench.columns.get(quantity, {})
        found = _find(path, table, quantity, column, required=quantity in (bench.drive, bench.output))
        if found is not None:
            columns[quantity], units[quantity] = found, _column(path, table, quantity, column)[1]
    if len({len(v) for v in columns.values()}) > 1:
        lengths = ", ".join(f"{q} {len(v)}" for q, v in columns.items())
        raise RecordingError(f"{path}: columns of unequal length ({lengths}); save as many samples of each")
    if not bench.columns.get("time", {}).get("quasistatic") and "time" not in columns:
        raise RecordingError(f"{path}: no time column among {', '.join(available)}; name one time_s or map it in [columns.time]")
    if split is not None:
        if split not in table:
            raise RecordingError(f"{path}: no column {split} to split at; the file has {', '.join(available)}")
        bad = ~np.isfinite(np.asarray(table[split], float))
        if bad.any():
            raise RecordingError(
                f"{path}: {split}, at which the file is split, is no number in row {int(np.argmax(bad))}; fill it in"
            )
        labels = list(dict.fromkeys(table[split]))
        parts = [(f"{path.name}[{split}={label:g}]", table[split] == label) for label in labels]
    else:
        parts = [(path.name, np.ones(len(columns[bench.drive]), bool))]
    if not bench.columns.get("time", {}).get("quasistatic"):
        for name, rows in parts:
            _refuse_clipping(name, {q: v[rows] for q, v in columns.items()}, bench)
    if bench.columns.get("time", {}).get("merge"):
        columns, filled = merge_captures([{q: v[rows] for q, v in columns.items()} for _, rows in parts], bench, path)
        if filled:
            origin = {**origin, "metadata": {**origin["metadata"], "bridged_samples": filled}}
        return [_one(path.name, columns, units, origin, bench)]
    return [_one(name, {q: v[rows] for q, v in columns.items()}, units, origin, bench) for name, rows in parts]


def _refuse_missing(path, table, bench):
    """Where several columns are missing, one line names them all (of a single one, `_find` tells how to name it)."""
    wanted = (*(() if bench.columns.get("time", {}).get("quasistatic") else ("time",)), bench.drive, bench.output)
    missing = [q for q in dict.fromkeys(wanted) if _column(path, table, q, bench.columns.get(q, {}))[0] is None]
    if len(missing) > 1:
        usual = ", ".join(bench.columns.get(q, {}).get("name", USUAL[q]) for q in missing)
        raise RecordingError(
            f"{path}: no columns for {', '.join(missing)} among {', '.join(table)}; name them {usual} or map them in [columns] of the bench"
        )


def _refuse_clipping(name, columns, bench):
    """Clipping is seen in what the converter read: before gaps are filled, captures joined or an emf is integrated."""
    for quantity, values in columns.items():
        if quantity not in ("time", *BYSTANDERS):
            what = f"the emf of {quantity}" if "emf_turns" in bench.columns.get(quantity, {}) else quantity
            try:
                refuse_clipping(name, what, values, None if quantity == bench.drive else columns[bench.drive])
            except RecordingError as error:
                error.shown = {**error.shown, "name": name, "time": columns.get("time")}
                raise


def _column(path, table, quantity, column):
    """(name, unit) of a quantity's column, as mapped by the bench or by its name; (None, None) where there is none."""
    if "name" in column:
        return (column["name"], column.get("unit")) if column["name"] in table else (None, None)
    found = [n for n in table if _parse(n)[0] == quantity]
    if len(found) > 1:
        raise RecordingError(
            f"{path}: columns {' and '.join(found)} both hold the {quantity}; say which in [columns.{quantity}] of the bench (name = ...)"
        )
    return (found[0], column.get("unit", _parse(found[0])[1])) if found else (None, None)


def _find(path, table, quantity, column, required):
    name, unit = _column(path, table, quantity, column)
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


def _one(name, columns, units, origin, bench) -> Recording:
    quasistatic = bench.columns.get("time", {}).get("quasistatic")
    count = len(columns[bench.drive])
    if count < 2:
        raise RecordingError(f"{name}: holds one sample only; record again, or check the columns and the split of the file")
    metadata = dict(origin["metadata"])
    if quasistatic:
        columns = _uniform_loop({**columns}, bench, name)
        count = len(columns[bench.drive])
        time = np.arange(count) / count
        metadata["frequency_Hz"] = 1.0
        origin = {**origin, "quasistatic": True}
    else:
        if not np.isfinite(columns["time"]).all():
            sample = int(np.argmax(~np.isfinite(columns["time"])))
            raise RecordingError(f"{name}: the time of sample {sample} is no number; remove that row, or write its time")
        time = columns["time"] - columns["time"][0]
    channels = {q: v for q, v in columns.items() if q != "time"}
    if not quasistatic:
        if not np.median(np.diff(time)) > 0:
            raise RecordingError(f"{name}: time does not increase from most samples to the next; rewrite the time column")
        widest = int(round(np.diff(time).max() / max(float(np.median(np.diff(time))), 1e-300))) - 1
        time, channels, bridged = bridge_gaps(time, channels, bench.drive)
        if bridged:
            metadata |= {"bridged_samples": bridged, "widest_gap_samples": widest}
    check_sizes(name, channels, units, bench)
    refuse_constant(name, bench.output, channels[bench.output])
    column = bench.columns.get(bench.output, {})
    if "emf_turns" in column:
        dt = float(np.median(np.diff(time)))
        channels[bench.output] = integrate_emf(channels[bench.output], channels[bench.drive], dt, column)
    metadata = {k: _number(v) for k, v in metadata.items()}
    return Recording(time, channels, {}, {**origin, "metadata": metadata}, name)


def _number(value):
    try:
        return float(value)
    except (TypeError, ValueError):
        return value


def _uniform_loop(columns, bench, name):
    """A quasi-static loop given as points: closed, and resampled evenly along its length in (drive, output)."""
    x, y = columns[bench.drive], columns[bench.output]
    bad = ~(np.isfinite(x) & np.isfinite(y))
    if bad.any():
        raise RecordingError(f"{name}: not a number at point {int(np.argmax(bad))} of the loop; remove that point")
    refuse_constant(name, bench.drive, x)
    ahead = np.concatenate([[0], np.cumsum(np.abs(np.diff(x)))])
    # points that stand still in the drive carry no new information for a rate-independent loop
    keep = np.concatenate([[True], np.diff(ahead) > 0])
    ahead, x, y = ahead[keep], x[keep], y[keep]
    closing = abs(x[0] - x[-1])
    total = ahead[-1] + closing if closing > 1e-6 * np.ptp(x) else ahead[-1]
    if closing > 1e-6 * np.ptp(x):
        ahead, x, y = np.append(ahead, total), np.append(x, x[0]), np.append(y, y[0])
    # even steps of phase of a sine between the extremes put points where the loop bends
    n = 512
    top, bottom = x.max(), x.min()
    phase = 2 * np.pi * np.arange(n) / n
    drive = 0.5 * (top + bottom) + 0.5 * (top - bottom) * np.cos(phase)
    travelled = np.concatenate([[0], np.cumsum(np.abs(np.diff(drive)))])
    start = ahead[np.argmax(x)]
    place = (start + travelled * (total / (2 * (top - bottom)))) % total
    return {bench.drive: np.interp(place, ahead, x), bench.output: np.interp(place, ahead, y)}
