"""Plants of the closed loop, python-control citizens and the tracking study."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from magjax.control.tracking import aperiodic, perturbed, sinusoid, track
from magjax.errors import ConfigurationError
from magjax.inverse import PlainActuator
from magjax.inverse.events import HeldCurrent
from tests.test_simulate import actuator


@pytest.fixture(scope="module")
def plant():
    from magjax.bench import load_bench

    return PlainActuator.from_actuator(load_bench("aa-050h").actuator())


def test_strategies_rank_as_in_the_paper(plant):
    time, wanted = sinusoid(plant, 5e-4)
    error = {s: track(plant, plant, time, wanted, s).errors()[0] for s in ("proportional", "static_inverse", "dynamic_inverse", "l1")}
    assert error["dynamic_inverse"] < 0.3 * error["static_inverse"] < error["proportional"]
    assert error["l1"] < error["proportional"]


def test_over_relaxing_saturates_on_a_mismatched_plant(plant):
    time, wanted = aperiodic(plant, 5e-4)
    model = perturbed(plant)
    kept = track(plant, model, time, wanted, "l1")
    relaxed = track(plant, model, time, wanted, "l1_over_relaxed")
    assert relaxed.saturated > kept.saturated and relaxed.errors()[0] > 1.5 * kept.errors()[0]
    with pytest.raises(ConfigurationError, match="unknown"):
        track(plant, plant, time, wanted, "magic")


def test_linear_part_and_the_nlsys_are_the_plant(plant):
    import control

    from magjax.control.models import actuator_system, linear_part

    rod = linear_part(plant)
    assert rod.input_labels == ["u_A2_per_m2"] and rod.output_labels == ["displacement_m"]
    assert np.abs(rod.dcgain()) == pytest.approx(plant.l_rod * plant.lambda_s / plant.M_s**2)
    T = 1e-4
    t = T * np.arange(80)
    current = 0.3 * np.sin(2 * np.pi * 40 * t)
    system = actuator_system(plant, T)
    system.reset()
    start = [system.actuator.displacement, 0.0]
    got = control.input_output_response(system, t, current, start).outputs
    alone = HeldCurrent(plant)
    expected = []
    for I in current:
        expected.append(alone.displacement)
        alone.hold(float(I), T)
    assert np.ravel(got) == pytest.approx(np.array(expected), abs=1e-15)


def test_effects_of_the_plant_that_are_not_simulated_are_refused(plant):
    with pytest.raises(ConfigurationError, match="backlash"):
        HeldCurrent(dataclasses.replace(plant, effects={"backlash": {"g": 1e-6}}))


def test_lagging_amplifier_of_the_held_plant():
    plant = PlainActuator.from_actuator(actuator(12))
    late = HeldCurrent(dataclasses.replace(plant, effects={"amplifier_lag": {"tau": 1e-3}}))
    late.hold(0.5, 1e-3)
    assert late.current == pytest.approx(0.5 * (1 - np.exp(-1)), rel=1e-12)


@pytest.mark.parametrize("arguments", [["design", "--json"], ["simulate", "--json", "--strategy", "dynamic_inverse", "--out", "track.csv"]])
def test_commands(arguments, tmp_path):
    done = subprocess.run([sys.executable, "-m", "magjax", "control", *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    if arguments[0] == "design":
        assert summary["gap"] < 1e-6 and summary["hard_rows_broken"] == []
    else:
        assert summary["rms_m"] < 1e-6 and (tmp_path / "track.csv").exists()


def test_command_errors_are_one_line(tmp_path):
    for arguments, words in ((["fly"], "no action"), (["design", "--u-bar", "-1"], "u_bar"), (["simulate", "--strategy", "x"], "unknown")):
        done = subprocess.run([sys.executable, "-m", "magjax", "control", *arguments], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1
