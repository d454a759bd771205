"""Recordings out: CSV, NetCDF, MATLAB, Parquet, and datasets as NetCDF, each whole or not at all."""

import json
import math
from pathlib import Path

import numpy as np

from .errors import ConfigurationError

NAMES = {
    "current": "current_A", "command": "command_A", "field": "field_A_per_m", "displacement": "displacement_m", "reference": "reference_m",
    "flux_density": "flux_density_T", "magnetization": "magnetization_A_per_m", "polarization": "polarization_C_per_m2",
    "voltage": "voltage_V", "temperature": "temperature_degC",
}  # fmt: skip
UNITS = {
    "current": "A", "command": "A", "field": "A/m", "displacement": "m", "reference": "m", "flux_density": "T", "magnetization": "A/m",
    "polarization": "C/m^2", "voltage": "V", "temperature": "degC",
}  # fmt: skip


def as_json(content, indent: int | None = None) -> str:
    """JSON that any parser takes: null for what is not a finite number."""

    def plain(value):
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(content), allow_nan=False, indent=indent)


def write_recording(path, recording) -> None:
    """Write a recording; the ending says how: .csv, .nc, .mat or .parquet (needs pyarrow)."""
    path = Path(path)
    writer = {".csv": _csv, ".nc": _netcdf, ".mat": _mat, ".parquet": _parquet}.get(path.suffix.lower())
    if writer is None:
        raise ConfigurationError(f"{path}: ending {path.suffix or '(none)'} is unknown; write .csv, .nc, .mat or .parquet")
    _whole(path, lambda partial: writer(partial, recording))


def write_dataset(path, data) -> None:
    """Write an xarray Dataset as NetCDF, whole or not at all; raises `ConfigurationError` where it cannot be."""
    _whole(Path(path), lambda partial: data.to_netcdf(partial, engine="h5netcdf"))


def _whole(path, write):
    """`write` a file beside `path`, then put it in its place."""
    partial = path.with_name(path.name + ".part")
    try:
        write(partial)
        partial.replace(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None
    finally:
        partial.unlink(missing_ok=True)


def _columns(recording):
    return {"time_s": recording.time, **{NAMES.get(c, c): v for c, v in recording.channels.items()}}


def _csv(path, recording):
    columns = _columns(recording)
    head = [f"# {k}: {v}" for k, v in recording.origin.get("metadata", {}).items()]
    rows = np.stack(list(columns.values()), axis=1)
    with open(path, "w", encoding="utf-8") as stream:
        stream.write("\n".join([*head, ",".join(columns)]) + "\n")
        np.savetxt(stream, rows, delimiter=",", fmt="%.12g")


def _netcdf(path, recording):
    import xarray as xr

    data = {c: ("time", v, {"units": UNITS.get(c, "")}) for c, v in recording.channels.items()}
    attrs = {k: v for k, v in recording.origin.get("metadata", {}).items() if isinstance(v, (int, float, str))}
    xr.Dataset(data, coords={"time": ("time", recording.time, {"units": "s"})}, attrs=attrs).to_netcdf(path, engine="h5netcdf")


def _mat(path, recording):
    from scipy.io import savemat

    savemat(path, _columns(recording), appendmat=False)


def _parquet(path, recording):
    from .acquire.export import write_parquet

    write_parquet(path, _columns(recording), recording.origin.get("metadata", {}))
