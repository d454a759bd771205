"""MATLAB v7.3 and NetCDF with mapped columns read as CSV does."""

import dataclasses

import numpy as np
import pytest

from magjax.bench import load_bench
from magjax.errors import RecordingError
from magjax.recording import load_recordings

N = 1000


def columns():
    t = np.arange(N) * 1e-4
    return {"time_s": t, "current_A": 0.5 * np.sin(2 * np.pi * 20 * t), "lvdt_volts": 1 + 0.4 * np.cos(2 * np.pi * 20 * t)}


@pytest.fixture
def bench():
    return dataclasses.replace(
        load_bench("aa-050h"), columns={"displacement": {"name": "lvdt_volts", "scale": 25.0, "offset": -5.0, "unit": "um"}}
    )


def expected():
    return (25 * columns()["lvdt_volts"] - 5) * 1e-6


def test_matlab_7_3(tmp_path, bench):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "run.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns().items():
            file.create_dataset(name, data=values[None])  # MATLAB stores a column vector transposed
    got = load_recordings([str(path)], bench)[0]
    assert got.channels["displacement"] == pytest.approx(expected()) and got.frequency() == pytest.approx(20, rel=1e-3)


def test_matlab_5(tmp_path, bench):
    from scipy.io import savemat

    savemat(tmp_path / "run.mat", {k: v[:, None] for k, v in columns().items()})
    assert load_recordings([str(tmp_path / "run.mat")], bench)[0].channels["displacement"] == pytest.approx(expected())


def test_mapped_netcdf(tmp_path, bench):
    import xarray as xr

    data = {k: ("time", v) for k, v in columns().items() if k != "time_s"}
    xr.Dataset(data, coords={"time_s": ("time", columns()["time_s"])}).to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    assert load_recordings([str(tmp_path / "run.nc")], bench)[0].channels["displacement"] == pytest.approx(expected())


def test_a_file_that_is_no_matlab_file_is_told(tmp_path, bench):
    (tmp_path / "run.mat").write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="run.mat"):
        load_recordings([str(tmp_path / "run.mat")], bench)
