"""Sweeps: the same numbers on processes and devices, resumed, through the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

from magjax.bench import load_bench
from magjax.cli import main
from magjax.errors import ConfigurationError
from magjax.simulate import sweep

ROOT = Path(__file__).resolve().parents[2]
GRID = {"frequencies": [10.0, 60.0, 120.0], "amplitudes": [0.2, 0.5, 0.8], "samples": 60, "chunk": 4}


@pytest.fixture(scope="module")
def plain():
    return sweep(load_bench("aa-050h").actuator(), **GRID)


@pytest.mark.long
def test_processes_and_a_resumed_sweep(plain, tmp_path):
    actuator, path = load_bench("aa-050h").actuator(), tmp_path / "sweep"
    seen = []
    first = sweep(actuator, **GRID, executor="processes:2", checkpoint=path, progress=lambda *a: seen.append(a))
    assert first.identical(plain) and [a[1] for a in seen] == [1, 2, 3]
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) == 4  # the header, chunks of 4, 4 and 1 points
    path.write_bytes(b"".join(lines[:2]) + lines[3][:50])
    seen.clear()
    again = sweep(actuator, **GRID, checkpoint=path, progress=lambda *a: seen.append(a))
    assert again.identical(plain) and [a[1] for a in seen] == [2, 3]
    with pytest.raises(ConfigurationError, match="amplitude 5, offset 0 leads the field"):
        sweep(actuator, [60.0], [0.5, 5.0], samples=60, executor="processes:1")
    # waveforms travel too
    kept = sweep(actuator, [60.0], [0.5], samples=60, keep=True, checkpoint=tmp_path / "kept")
    assert kept.reading.shape == (1, 1, 1, 60)


CODE = """
import jax, sys
jax.config.update("jax_enable_x64", True)
from magjax.bench import load_bench
from magjax.simulate import sweep
from tests.scale.test_sweep import GRID
assert jax.local_device_count() == 3
seen = []
data = sweep(load_bench("aa-050h").actuator(), **GRID)
data.to_netcdf(sys.argv[1], engine="h5netcdf")
"""


@pytest.mark.long
def test_several_devices(plain, tmp_path):
    """Three devices, chunks of four: one row is made up, each device holds two."""
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=3", "PYTHONPATH": str(ROOT)}
    environment["JAX_COMPILATION_CACHE_DIR"] = jax.config.jax_compilation_cache_dir or ""
    subprocess.run([sys.executable, "-c", CODE, str(tmp_path / "s.nc")], env=environment, check=True, cwd=tmp_path)
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as found:
        for name in plain.data_vars:
            assert found[name].values == pytest.approx(plain[name].values, rel=1e-12)


@pytest.mark.parametrize(("backend", "count"), [("cpu", 2), ("gpu", 1)])
def test_a_gpu_takes_larger_chunks(monkeypatch, backend, count):
    jobs = []

    def run_job(job, *a, **k):
        jobs.append(job)
        raise InterruptedError

    monkeypatch.setattr("magjax.simulate.run_job", run_job)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    with pytest.raises(InterruptedError):
        sweep(load_bench("aa-050h").actuator(), np.linspace(10.0, 300.0, 60), np.linspace(0.1, 0.8, 10))
    assert len(jobs[0].chunks) == count


PLATFORMS = """
import jax
from magjax.cli.runtime import prepare_jax
prepare_jax(many=True)
print(jax.config.jax_platforms)
prepare_jax()
print(jax.config.jax_platforms)
"""


@pytest.mark.parametrize(("asked", "found"), [("", ["None", "cpu"]), ("cuda", ["cuda", "cuda"])], ids=["usual", "asked for"])
def test_fits_keep_to_the_processor_and_sweeps_do_not(tmp_path, asked, found):
    environment = {k: v for k, v in os.environ.items() if k != "JAX_PLATFORMS"} | {"MAGJAX_CACHE": str(tmp_path)}
    environment |= {"JAX_PLATFORMS": asked} if asked else {}
    done = subprocess.run([sys.executable, "-c", PLATFORMS], env=environment, cwd=ROOT, check=True, capture_output=True, text=True)
    assert [line or "None" for line in done.stdout.splitlines()] == found


@pytest.mark.parametrize(("frequencies", "why"), [
    ("10:300:100000000000", "values along one axis"), ("10:300:0", "give 1 to"), ("10:300:900000", "54,000,000 steady states in one sweep"),
])  # fmt: skip
def test_a_sweep_that_no_memory_holds_is_refused(tmp_path, capsys, frequencies, why):
    arguments = ["--frequencies", frequencies, "--amplitudes", "0.1:0.8:60", "--out", str(tmp_path / "a.nc"), "--quiet"]
    assert main(["sweep", *arguments]) == 2
    said = capsys.readouterr().err
    assert why in said and said.count("\n") == 1 and not list(tmp_path.iterdir())


def test_on_the_command_line(tmp_path, capsys):
    arguments = ["sweep", "--frequencies", "10,60", "--amplitudes", "0.3,0.6", "--checkpoint", str(tmp_path / "kept"), "--json"]
    assert main([*arguments, "--out", str(tmp_path / "a.nc")]) == 0
    assert main([*arguments, "--out", str(tmp_path / "b.nc")]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["points"] == 4
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as a, xr.open_dataset(tmp_path / "b.nc", engine="h5netcdf") as b:
        assert a.identical(b) and np.all(a.peak_to_peak > 0)
    assert main(["sweep", "--frequencies", "10,70", "--checkpoint", str(tmp_path / "kept"), "--quiet"]) == 2
    assert "another job" in capsys.readouterr().err
