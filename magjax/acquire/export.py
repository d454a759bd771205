"""A log into NetCDF, CSV, MAT or Parquet, with its provenance: device, firmware, calibration, command line, sha256."""

import hashlib
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError
from .log import read_log
from .protocol import COLUMNS, SI

UNITS = {COLUMNS[q]: next(iter(units)) for q, units in SI.items()} | {"command_A": "A"}
QUANTITIES = {column: quantity for quantity, column in COLUMNS.items()} | {"command_A": "command"}


def export_log(path, target) -> list[Path]:
    """Write every segment of a log; the ending of `target` says how: .nc, .csv, .mat, .parquet. Several are numbered.

    Raises `ConfigurationError` for an unknown ending or a place that cannot be written, `RecordingError` for an empty log.
    """
    path, target = Path(path), Path(target)
    writer = known_ending(target)
    if target.is_dir():
        raise ConfigurationError(f"{target}: is a folder; give the name of a file in it")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    segments, written = read_log(path), []
    for k, (table, metadata) in enumerate(segments):
        place = target if len(segments) == 1 else target.with_name(f"{target.stem}_{k:03d}{target.suffix}")
        partial = place.with_name(place.name + ".part")
        try:
            writer(partial, table, {**metadata, "log": path.name, "log_sha256": digest})
            partial.replace(place)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise ConfigurationError(f"{place}: cannot be written ({error.strerror or error}); choose another place") from None
        written.append(place)
    return written


def _netcdf(path, table, metadata):
    import xarray as xr

    data = {QUANTITIES[c]: ("time", v, {"units": UNITS[c]}) for c, v in table.items() if c != "time_s"}
    xr.Dataset(data, coords={"time": ("time", table["time_s"], {"units": "s"})}, attrs=metadata).to_netcdf(path, engine="h5netcdf")


def _csv(path, table, metadata):
    head = [f"# {k}: {str(v).replace(chr(10), ' ')}" for k, v in metadata.items()]
    with open(path, "w", encoding="utf-8") as stream:
        stream.write("\n".join([*head, ",".join(table)]) + "\n")
        np.savetxt(stream, np.stack(list(table.values()), axis=1), delimiter=",", fmt="%.12g")


def _mat(path, table, metadata):
    from scipy.io import savemat

    savemat(path, {**table, "provenance": "\n".join(f"{k}: {v}" for k, v in metadata.items())}, appendmat=False)


def write_parquet(path, table, metadata):
    """Columns (SI, names with units) as Parquet, `metadata` in its schema; raises `ConfigurationError` without pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ConfigurationError(f"{path.stem}: Parquet needs pyarrow; type: pip install pyarrow, or write .nc") from None
    made = pyarrow.table({c: np.asarray(v, float) for c, v in table.items()})
    made = made.replace_schema_metadata({k: str(v) for k, v in metadata.items()})
    pyarrow.parquet.write_table(made, path)


WRITERS = {".nc": _netcdf, ".csv": _csv, ".mat": _mat, ".parquet": write_parquet}


def known_ending(target: Path):
    """The writer for a file's ending; raises `ConfigurationError` for one that is unknown."""
    writer = WRITERS.get(target.suffix.lower())
    if writer is None:
        raise ConfigurationError(f"{target}: ending {target.suffix or '(none)'} is unknown; write {', '.join(WRITERS)}")
    return writer
