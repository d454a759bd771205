"""magjax simulate and sweep on the command line: what they take, what they write, whole or not at all."""

import json

import numpy as np
import pytest
import xarray as xr

from magjax.bench import load_bench
from magjax.cli import main
from magjax.errors import ConfigurationError
from magjax.simulate import simulate
from magjax.writers import write_dataset


def one_line(capsys):
    text = capsys.readouterr().err.strip()
    assert "\n" not in text
    return text


def drive_file(path, periods, n=200, frequency=50.0):
    t = np.arange(int(periods * n)) / (n * frequency)
    rows = np.stack([t, 0.1 + 0.5 * np.sin(2 * np.pi * frequency * t)], axis=1)
    np.savetxt(path, rows, delimiter=",", header="time_s,current_A", comments="")
    return rows[:, 1], t[1]


@pytest.mark.parametrize("command", ["simulate", "sweep"])
def test_a_folder_is_no_file_to_write(tmp_path, capsys, command):
    assert main([command, "--out", str(tmp_path), "--quiet"]) == 2
    assert f"{tmp_path}: is a folder; give a file in it" in one_line(capsys)


def test_a_dataset_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.nc"
    write_dataset(path, xr.Dataset({"x": ("time", np.arange(3.0))}))

    class Killed(xr.Dataset):
        __slots__ = ()

        def to_netcdf(self, target, **_):
            target.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(path, Killed())
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]
    with xr.open_dataset(path, engine="h5netcdf") as kept:
        assert kept.x.values.tolist() == [0, 1, 2]
    with pytest.raises(ConfigurationError, match="cannot be written .*; choose another place"):
        write_dataset(tmp_path, xr.Dataset())


@pytest.mark.parametrize(("periods", "periodic"), [(3, True), (2.4, False)])
def test_a_drive_needs_time_and_current_only(tmp_path, periods, periodic):
    """Whole periods are led to their steady state; others run once, with no jump from their end to their start."""
    drive, dt = drive_file(tmp_path / "drive.csv", periods)
    out = tmp_path / "s.nc"
    assert main(["simulate", "--drive", str(tmp_path / "drive.csv"), "--out", str(out), "--quiet"]) == 0
    expected = simulate(load_bench("aa-050h").actuator(), drive, dt, periodic=periodic)
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found.displacement.values == pytest.approx(np.asarray(expected.displacement), rel=1e-6)
        assert found.reading.values == pytest.approx(np.asarray(expected.reading), rel=1e-6)
        assert found.reading.attrs["units"] == "m" and found.command.attrs["units"] == "A"


def test_a_field_driven_bench_is_read_in_tesla(tmp_path, capsys):
    out = tmp_path / "s.nc"
    assert main(["simulate", "--bench", "rod-eddy", "--amplitude", "200", "--out", str(out), "--json", "--quiet"]) == 0
    stroke = json.loads(capsys.readouterr().out)["peak_to_peak"]
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found.reading.attrs["units"] == "T" and np.ptp(found.reading.values) == pytest.approx(stroke)
        assert found.current.attrs["units"] == found.command.attrs["units"] == "A/m"


def test_a_file_with_several_drives_is_not_cut_to_its_first(tmp_path, capsys):
    loop = 200 * np.sin(2 * np.pi * np.arange(64) / 64)
    rows = np.concatenate([np.stack([np.full(64, k), loop / (k + 1)], axis=1) for k in (0, 1)])
    np.savetxt(tmp_path / "loops.csv", rows, delimiter=",", header="loop,H_A_per_m", comments="")
    assert (
        main(
            [
                "simulate",
                "--bench",
                "material-loops",
                "--drive",
                str(tmp_path / "loops.csv"),
                "--out",
                str(tmp_path / "s.nc"),
                "--quiet",
            ]
        )
        == 2
    )
    assert "holds 2 recordings" in one_line(capsys)


@pytest.mark.parametrize("command", ["simulate", "sweep"])
def test_what_has_not_settled_is_not_to_be_trusted(tmp_path, capsys, monkeypatch, command):
    monkeypatch.setattr("magjax.simulate.MOST_PERIODS", 3)
    grid = ["--frequency", "300", "--amplitude"] if command == "simulate" else ["--frequencies", "300", "--amplitudes"]
    assert main([command, *grid, "0.05", "--out", str(tmp_path / "a.nc"), "--quiet"]) == 4
    assert "not settled" in capsys.readouterr().out and (tmp_path / "a.nc").is_file()
    assert main([command, *grid, "0.8", "--out", str(tmp_path / "a.nc"), "--quiet"]) == (4 if command == "simulate" else 0)
    assert "not settled" in capsys.readouterr().out or command == "sweep"


def test_a_sweep_outside_the_plane_writes_nothing(tmp_path, capsys):
    assert main(["sweep", "--frequencies", "10", "--amplitudes", "5,9", "--out", str(tmp_path / "a.nc"), "--quiet"]) == 2
    assert "outside the Preisach plane" in one_line(capsys) and not list(tmp_path.iterdir())
