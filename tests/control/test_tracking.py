"""Plants of the closed loop, python-control citizens and the tracking study."""

import dataclasses
import json

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
    error = {
        s: track(plant, plant, time, wanted, s).errors()[0] for s in ("proportional", "static_inverse", "dynamic_inverse", "l1")
    }
    assert error["dynamic_inverse"] < 0.05 * error["static_inverse"] < error["proportional"]
    assert error["l1"] < error["proportional"] and error["dynamic_inverse"] < 3e-8


@pytest.mark.parametrize(
    ("effects", "frequency", "gain"),
    [
        ({"amplifier_lag": {"tau": 4e-4}}, 20.0, 5),
        ({"amplifier_lag": {"tau": 4e-4, "order2": 0.25}}, 20.0, 5),
        ({"quartic_magnetostriction": {"b": 0.25}}, 20.0, 50),
        ({"second_mode": {"gain": 0.15, "f2": 180.0, "xi2": 0.1}}, 100.0, 10),
    ],
    ids=["amplifier_lag", "second-order", "quartic", "second_mode"],
)
def test_knowing_what_is_concealed_pays_in_tracking(plant, effects, frequency, gain):
    true = dataclasses.replace(plant, effects=effects)
    time, wanted = sinusoid(plant, 1e-2 / frequency, frequency)
    blind, told = (track(true, model, time, wanted, "dynamic_inverse").errors(0.5)[0] for model in (plant, true))
    assert told * gain < blind


def test_noise_reaches_feedback_only(plant):
    time, wanted = sinusoid(plant, 5e-4, periods=3)
    for strategy, changes in (("dynamic_inverse", False), ("l1", True), ("proportional", True)):
        quiet, noisy = (track(plant, plant, time, wanted, strategy, noise=n) for n in (0.0, 3e-7))
        assert (np.abs(noisy.reached - quiet.reached).max() > 1e-8) == changes


def test_what_is_out_of_reach_is_counted(plant):
    time, wanted = sinusoid(plant, 5e-4, periods=2)
    for strategy in ("static_inverse", "dynamic_inverse"):
        assert (
            track(plant, plant, time, wanted, strategy).saturated == 0 < track(plant, plant, time, 2.5 * wanted, strategy).saturated
        )


def test_interconnected_loop_is_the_study(plant):
    """The same l1 run through python-control's `interconnect`, with a wrong model."""
    import control

    from magjax.control import TrackingProblem, design
    from magjax.control.models import tracking_loop
    from magjax.control.problem import rod
    from magjax.control.realize import reduced_controller

    T, model = 5e-4, perturbed(plant)
    time, wanted = sinusoid(plant, T, periods=2)
    run = track(plant, model, time, wanted, "l1")
    controller = reduced_controller(
        design(TrackingProblem(plant=rod(model.f0, model.xi, T, 1e6 * model.l_rod * model.lambda_s), T=T))
    )
    loop = tracking_loop(controller, plant, model)
    assert loop.input_labels == ["reference_um"] and loop.output_labels == ["displacement_m", "control_Ms2", "current_A"]
    ahead = 1e6 * wanted[np.minimum(np.arange(len(time)) + 2, len(time) - 1)]
    out = control.input_output_response(loop, time, ahead, loop.start).outputs
    assert out[0] == pytest.approx(run.reached, abs=1e-12) and out[2] == pytest.approx(run.current, abs=1e-9)


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
    assert late.amplifier[0] == pytest.approx(0.5 * (1 - np.exp(-1)), rel=1e-12)


def command(arguments, capsys):
    from magjax.cli import main

    status = main(["control", *arguments])
    return status, capsys.readouterr()


def test_commands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, said = command(["design", "--json"], capsys)
    summary = json.loads(said.out)
    assert status == 0 and summary["gap"] < 1e-6 and summary["hard_rows_broken"] == [] and "margin" in summary["message"]
    status, said = command(["simulate", "--json", "--strategy", "dynamic_inverse", "--out", "track.csv"], capsys)
    assert status == 0 and json.loads(said.out)["rms_m"] < 1e-7 and (tmp_path / "track.csv").exists()
    status, said = command(["bounds", "--json", "--T", "5e-4"], capsys)
    summary = json.loads(said.out)
    assert (
        "largest h that holds" in summary["4.2"]["note"] and summary["4.3"]["simulated_A_per_m"] <= summary["4.3"]["bound_A_per_m"]
    )


def test_nothing_is_left_half_written(tmp_path, capsys, monkeypatch):
    """A disk that fills while the table is written: one line, no file."""
    import magjax.inverse.command as writing

    def full(path, *rest, **options):
        path.write_text("time_s")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing.np, "savetxt", full)
    for out in ("track.csv", "."):
        status, said = command(["simulate", "--strategy", "dynamic_inverse", "--out", str(tmp_path / out)], capsys)
        assert status == 2 and said.err.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_command_errors_are_one_line(capsys):
    wrong = (
        (["fly"], "no action"),
        (["design", "--u-bar", "-1"], "u_bar"),
        (["design", "--w-bar", "0"], "w_bar"),
        (["design", "--taps", "2"], "taps"),
        (["design", "--c-w", "-1"], "c_w"),
        (["simulate", "--T", "0"], "sample time"),
        (["simulate", "--strategy", "x"], "unknown"),
    )
    for arguments, words in wrong:
        status, said = command(arguments, capsys)
        assert status == 2 and words in said.err and said.err.count("\n") == 1
