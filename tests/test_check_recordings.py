"""Check recordings: predictions, and a word where their drive leaves the plane that was fitted."""

import json

import numpy as np
import pytest

from fitting.check import beyond_plane, check_errors
from fitting.reach import beyond_text
from fitting.report.tables import checks
from fitting.verdict import Diagnosis
from magjax.bench import load_bench
from magjax.errors import ConfigurationError
from magjax.recording import Recording
from magjax.simulate import simulate


def recording(amplitude, name, periods=3, n=200):
    phase = 2 * np.pi * np.arange(int(periods * n)) / n
    channels = {"current": amplitude * np.sin(phase), "displacement": 2e-5 + 1e-6 * np.sin(phase)}
    return Recording(np.arange(len(phase)) / (50 * n), channels, {}, {"file": f"runs/{name}"}, name)


@pytest.mark.parametrize("periods", [3, 0.4])
def test_a_drive_beyond_the_plane_is_predicted_and_told(periods):
    """The plane of this bench ends at 0.918 A: a drive of 1.377 A leaves it by a quarter of its width, periodic or not."""
    bench = load_bench("aa-050h")
    actuator = bench.actuator()
    runs = [recording(0.88, "within.csv", periods), recording(1.377, "beyond.csv", periods)]
    assert beyond_plane(actuator, runs[0], bench) == 0.0
    rows = check_errors(actuator, actuator, runs, bench)
    assert [r["beyond_plane"] for r in rows] == [0.0, pytest.approx(0.25, abs=3e-3)]
    text = beyond_text(rows)
    assert "beyond.csv by 25 %" in text and "within.csv" not in text and "saturated" in text and "\n" not in text
    found = Diagnosis("nothing_missing", "All is well.", check=tuple(rows))
    assert str(found).endswith(text) and json.loads(json.dumps(found.as_dict()))["message"] == f"All is well. {text}"
    assert text in checks(rows)["note"]
    assert beyond_text(rows[:1]) == "" and beyond_text([{"file": "old"}]) == ""
    assert str(Diagnosis("nothing_missing", "All is well.", check=tuple(rows[:1]))) == "nothing_missing: All is well."


def test_a_simulation_still_refuses_unless_told_to_saturate():
    actuator, drive = load_bench("aa-050h").actuator(), 1.4 * np.sin(np.arange(200) / 20)
    with pytest.raises(ConfigurationError, match="outside the Preisach plane"):
        simulate(actuator, drive, 1e-4)
    magnetization = np.asarray(simulate(actuator, drive, 1e-4, outside="saturate").magnetization)
    assert np.all(np.isfinite(magnetization)) and magnetization.max() == pytest.approx(7.87e5, rel=1e-3)
