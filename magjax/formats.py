"""Files into tables: CSV, NetCDF, MATLAB and acquisition logs as columns of numbers by their names, with what is stated above them."""

from pathlib import Path

import numpy as np

from .columns import parse_name
from .errors import MagjaxError, RecordingError

SPELLED = {
    "ampere": "A", "amperes": "A", "amp": "A", "metre": "m", "meter": "m", "metres": "m", "meters": "m", "second": "s", "seconds": "s",
    "sec": "s", "millisecond": "ms", "milliseconds": "ms", "micrometre": "um", "micrometer": "um", "micron": "um", "millimetre": "mm",
    "millimeter": "mm", "tesla": "T", "volt": "V", "volts": "V",
}  # fmt: skip
TEXT = (".csv", ".txt", ".dat", ".tsv", "")  # read as CSV


def read_table(path: Path) -> list:
    """(columns, metadata) of every table in a file; one line says what is wrong with it."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file; check the name")
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; name its files (for instance {path}/*.csv)")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record again")
    suffix = path.suffix.lower()
    readers = {".nc": _read_netcdf, ".mat": _read_mat, ".mjlog": _read_log} | dict.fromkeys(TEXT, read_csv)
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


def read_csv(path):
    """(columns, metadata) of a CSV: comments above, one header row, rows of numbers; raises `RecordingError` naming the mend."""
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
            key = name if parse_name(name)[0] and parse_name(name)[1] else f"{name}_{unit}".replace("/", "_per_").rstrip("_")
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
