"""The founding paper's riddle: what its command and what it shows are in tests/studies/riddle.py; here that it still comes out so."""

import json
from pathlib import Path

import numpy as np
import pytest

from fitting.experiments import CALIBRATION, SHUNT

KEPT = Path(__file__).parent / "studies" / "riddle.json"


def untrue(told) -> list:
    """What of the story did not come out so: names of the points that fail."""
    first, second = told["command and reading"], told["shunt and calibration"]
    R, f0, xi = (first["plain"][n][0] for n in ("coil.R_eddy", "mechanics.f0", "mechanics.xi"))
    faster = second["check"][0]  # the levels that the starts left in each recording are not foretold
    points = {
        "plain constants as strange as the paper's 70 ohm, 392 Hz, 0.78": R < 0.6 * 290 and 350 < f0 < 450 and 0.6 < xi < 0.9,
        "the plain fit misses": first["chi2n_plain"] > 20,
        "asks for shunt and calibration": first["next_experiment"] and first["next_experiment"]["channels"] == [SHUNT, CALIBRATION],
        "a group": first["verdict"] == "group" and "instruments and actuator are not told apart" in first["message"],
        "both instruments named": {e["name"] for e in second["effects"]} == {"amplifier_lag", "sensor_lag"},
        "attributed": second["verdict"] == "attributed" and second["next_experiment"] is None,
        "met": second["chi2n_repaired"] < 1.15,
        "the true constants": len(told["pulls"]) == 6 and max(abs(p) for p in told["pulls"].values()) < 3,
        "foretells": faster["rms_after"] < 0.2 * faster["rms_before"],
    }
    return [name for name, held in points.items() if not held]


def test_what_is_kept_tells_the_story():
    if not KEPT.exists():
        pytest.skip("python -m tests.studies.riddle has not been run here")
    assert untrue(json.loads(KEPT.read_text())) == []


def test_the_bench_is_what_the_riddle_says():
    from tests.studies.riddle import BUTTERWORTH, CORNER, LAG, butterworth, calibrations

    w = 2j * np.pi * np.array([0.0, CORNER])
    assert abs(butterworth(w)) == pytest.approx([1.0, np.sqrt(0.5)])
    tau, order2 = BUTTERWORTH
    assert butterworth(w) == pytest.approx(1 / (1 + w * tau + order2 * (w * tau) ** 2))
    assert LAG == 90e-6 and len(calibrations()) == 7


@pytest.mark.long
def test_the_papers_riddle():
    from tests.studies.riddle import tell

    assert untrue(tell()) == []


@pytest.mark.long
def test_a_second_mode_gives_way_to_the_filter_that_it_stands_for():
    """Here a second mode with the rod at the filter's place meets the recordings as well: both are named, in a group."""
    from fitting.demo import SINES, concealed_actuator
    from fitting.diagnose import diagnose
    from fitting.instruments import mode_as_filter
    from fitting.setup import Choices
    from magjax.bench import load_bench
    from magjax.effects import AmplifierLag, SensorLag
    from magjax.recording import Recording
    from magjax.simulate import simulate

    bench, rng = load_bench("aa-050h"), np.random.default_rng(7)
    truth = {"coil.R_eddy": 290.0, "mechanics.f0": 2000.0, "mechanics.xi": 0.1}
    true = (
        concealed_actuator(bench)
        .replace(truth)
        .with_effect(SensorLag(*mode_as_filter(400.0, 0.5**0.5)))
        .with_effect(AmplifierLag(90e-6))
    )
    runs = []
    for f, A, offset in SINES:
        drive = offset + A * np.sin(2 * np.pi * np.arange(2000) / 2000)
        reading = np.tile(np.asarray(simulate(true, drive, 1 / (2000 * f), periodic=True).reading)[::2], 4)
        channels = {"current": np.tile(drive[::2], 4), "displacement": reading + 41e-9 * rng.standard_normal(4000)}
        runs.append(Recording(np.arange(4000) / (1000 * f), channels, {}, {}, f"{f} Hz"))
    found = diagnose(runs, bench, choices=Choices(rest="negative", fine=250))
    groups = [{r["name"] for r in g} if isinstance(g[0], dict) else set(g) for g in found.groups]
    assert found.verdict == "group" and {"sensor_lag", "second_mode"} in groups, found.message
    assert found.next_experiment["channels"] == [SHUNT, CALIBRATION]
    assert abs(found.repaired.estimate("mechanics.f0").value / 2000 - 1) < 0.05
