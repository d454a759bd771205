"""Check recordings: predictions, and a word where their drive leaves the plane that was fitted."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.check import all_lines, beyond_plane, check_errors, predictions
from fitting.demo import concealed_actuator, record
from fitting.diagnose import diagnose
from fitting.diagnosis import Diagnosis
from fitting.missed_check import with_missed_check
from fitting.reach import beyond_text
from fitting.report.tables import checks
from fitting.setup import Choices
from fitting.spectra import reduce_recording
from fitting.task import Clock, Task
from magjax.bench import load_bench
from magjax.effects import AmplifierClipping
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


def test_recordings_of_all_kinds_are_foretold_together():
    """One program on the finest grid that any of them asks for: each prediction is that of the recording alone."""
    bench = load_bench("aa-050h")
    actuator, phase = bench.actuator(), 2 * np.pi * np.arange(1500) / 500
    many = Recording(
        np.arange(1500) / (20 * 500),
        {"current": 0.3 * np.sin(phase) + 0.2 * np.sin(7 * phase), "displacement": 2e-5 + 1e-6 * np.sin(phase)},
        {},
        {"file": "many.csv"},
        "many",
    )
    runs = [recording(0.6, "plain.csv"), recording(0.5, "short.csv", 0.4), many, recording(0.3, "small.csv")]
    together = predictions(actuator, runs, bench)
    for run, (predicted, measured, noise) in zip(runs, together, strict=True):
        ((alone, its_own, floor),) = predictions(actuator, [run], bench)
        assert predicted == pytest.approx(alone, abs=2e-4 * np.ptp(alone)) and np.array_equal(measured, its_own) and noise == floor
    assert [noise is None for *_, noise in together] == [False, True, False, False]
    rows = check_errors(actuator, actuator, runs, bench)
    assert [r["file"] for r in rows] == ["runs/plain.csv", "runs/short.csv", "many.csv", "runs/small.csv"]
    assert all(r["rms_before"] == r["rms_after"] > 0 for r in rows)


def test_a_drive_of_many_lines_is_foretold_to_its_noise():
    """The reading of eleven tones up to the 37th order has lines beyond the fortieth: without these it was missed by four times its noise."""
    bench, noise = load_bench("aa-050h"), 4e-8
    rng, phase = np.random.default_rng(4), np.arange(4 * 1600) / 1600
    orders = (3, 7, 11, 13, 17, 19, 23, 27, 31, 33, 37)
    current = 0.05 + sum(0.09 * np.sin(2 * np.pi * (k * phase + rng.random())) for k in orders)
    signals = simulate(bench.actuator(), current[:1600], 1 / (1600 * 7.0), periodic=True)
    reading = np.tile(np.asarray(signals.displacement), 4) + noise * rng.standard_normal(len(phase))
    run = Recording(phase / 7.0, {"current": current, "displacement": reading}, {}, {"file": "multisine.csv"}, "multisine")
    (row,) = check_errors(bench.actuator(), bench.actuator(), [run], bench)
    assert row["noise_rms"] == pytest.approx(noise, rel=0.05) and row["rms_after"] < 1.1 * noise
    narrow = reduce_recording(run, "current", "displacement")
    assert narrow.noise_rms > 2 * noise and len(all_lines(run, bench).reading) > len(narrow.reading)
    assert len(all_lines(recording(0.6, "plain.csv"), bench).reading) == len(narrow.reading)


def test_a_simulation_still_refuses_unless_told_to_saturate():
    actuator, drive = load_bench("aa-050h").actuator(), 1.4 * np.sin(np.arange(200) / 20)
    with pytest.raises(ConfigurationError, match="outside the Preisach plane"):
        simulate(actuator, drive, 1e-4)
    magnetization = np.asarray(simulate(actuator, drive, 1e-4, outside="saturate").magnetization)
    assert np.all(np.isfinite(magnetization)) and magnetization.max() == pytest.approx(7.87e5, rel=1e-3)


def missed(*ratios, verdict="attributed", chi2=0.9, effects=("creep",), groups=(), **more):
    """A diagnosis whose check recordings end at `ratios` of their noise."""
    fitted = SimpleNamespace(chi2_per_sample=chi2, recordings=(SimpleNamespace(residual_rms=4.2e-8),))
    rows = [
        {"file": f"runs/c{k}.csv", "rms_before": 9e-7, "rms_after": 4e-8 * r, "noise_rms": 4e-8, "beyond_plane": 0.0} | more
        for k, r in enumerate(ratios)
    ]
    named = tuple({"name": n} for n in effects)
    return Diagnosis(verdict, "So.", effects=named, groups=groups, check=tuple(rows), base=fitted, repaired=fitted)


CHECKS = [recording(0.5, f"c{k}.csv") for k in range(3)]
BOTH = ("creep", "amplifier_clipping")
CUT = "a search that was ended"


def with_missed(monkeypatch, found, again, check=CHECKS, clock=None):
    asked, clock = [], clock or Clock()
    monkeypatch.setattr("fitting.missed_check._contradiction", lambda *a: None)

    def diagnosed(task, left):
        asked.append(([r.name for r in task.recordings], [c.name for c in left]))
        clock.cut = again is CUT
        return missed(1, 1.5, effects=BOTH) if again is CUT else again

    task = Task((recording(0.8, "fit.csv"),), load_bench("aa-050h"), Choices(), clock=clock)
    return with_missed_check(task, found, check, diagnosed), asked


def test_a_check_missed_by_far_joins_the_recordings_where_more_is_named_with_it(monkeypatch):
    found, asked = with_missed(monkeypatch, missed(1, 13, 2), missed(1, 1.5, effects=BOTH))
    assert asked == [(["fit.csv", "c1.csv"], ["c0.csv", "c2.csv"])]
    assert [e["name"] for e in found.effects] == list(BOTH) and "c1.csv is missed by 13 times its noise" in found.message
    assert [r.get("joined") for r in found.check] == [None, True, None] and found.check[1]["rms_after"] == 4.2e-8
    joined, left = found.parted(CHECKS)
    assert [r.name for r in joined] == ["c1.csv"] and [r.name for r in left] == ["c0.csv", "c2.csv"]
    assert Diagnosis("data_problem", "No.").parted(CHECKS) == ([], [])
    # once: what it leaves to check is not asked for again
    assert with_missed(monkeypatch, found, None)[1] == []


@pytest.mark.parametrize(
    "again",
    [
        missed(1, 1),  # names no more
        missed(4, 3, effects=BOTH),  # foretells the others worse
        missed(1, 1, effects=BOTH, chi2=1.6),  # does not meet the noise
        missed(1, 1, effects=(), verdict="unknown_at"),
    ],
)
def test_else_it_is_told(monkeypatch, again):
    found, asked = with_missed(monkeypatch, missed(1, 13, 2), again)
    assert len(asked) == 1 and [e["name"] for e in found.effects] == ["creep"]
    assert found.message.startswith("So. c1.csv is missed by 13 times its noise") and "record more like it" in found.message
    assert not any("joined" in r for r in found.check)


def test_a_check_that_is_missed_as_expected_is_told_and_joins_nothing(monkeypatch):
    """A null whose recordings reached 0.557 A: one to 0.588 A was missed by 250 times its noise without a word."""
    found, asked = with_missed(monkeypatch, missed(1, 250, 2, expected_rms=8e-6, verdict="nothing_missing"), None)
    assert asked == [] and found.message.endswith("times their noise: c1.csv by 250; about as the fit expects, for they switch cells that no recording did.")
    assert with_missed(monkeypatch, missed(1, 4, 2), None)[0].message == "So."


@pytest.mark.parametrize(("minutes", "asks"), [(1e-9, 0), (np.inf, 1)], ids=["no time is left", "its search was ended"])
def test_without_time_for_it_the_first_diagnosis_stands(monkeypatch, minutes, asks):
    """A group whose rivals a second search had no time to fit would come out as a name."""
    clock = Clock(minutes)
    found, asked = with_missed(monkeypatch, missed(1, 13, 2), CUT, clock=clock)
    assert len(asked) == asks and clock.cut and [e["name"] for e in found.effects] == ["creep"]
    assert "there was no time" in found.message and "record more like it" not in found.message


@pytest.mark.parametrize(
    "found",
    [
        missed(1, 4, 2),  # what a rough density leaves
        missed(1, 13, 2, chi2=1.5),  # the fit itself has not met its noise
        missed(1, 13, 2, verdict="unknown_at"),
        missed(1, 13, 2, beyond_plane=0.2),  # and this is told by another sentence
        missed(1, 13, 2, noise_rms=0.0),
    ],
)
def test_a_diagnosis_that_it_does_not_concern_stands(monkeypatch, found):
    assert with_missed(monkeypatch, found, None) == (found, [])


def test_the_only_check_recording_never_joins(monkeypatch):
    found, asked = with_missed(monkeypatch, missed(13), None, CHECKS[:1])
    assert asked == [] and "give it as one of them, and others to check" in found.message


@pytest.mark.long
def test_physics_that_only_a_check_recording_reaches_is_found():
    bench, rng = load_bench("aa-050h"), np.random.default_rng(5)
    truth = concealed_actuator(bench, AmplifierClipping(inverse_limit=0.7, tau_L=1e-3))  # 1.4 A: asked for at 400 Hz alone
    drives = ((10, 0.8, 0.1), (30, 0.5, -0.2), (60, 0.8, 0.1), (100, 0.5, -0.2), (150, 0.7, 0.1))
    runs = [record(truth, *d, rng, f"r{d[0]}") for d in drives]
    check = [record(truth, *d, rng, f"c{d[0]}") for d in ((80, 0.6, 0.0), (400, 0.75, 0.1), (120, 0.7, 0.05))]
    assert diagnose(runs, bench, check=[check[0], check[2]]).verdict == "nothing_missing"
    found = diagnose(runs, bench, check=check)
    assert "amplifier_clipping" in {e["name"] for e in found.effects} | {n for g in found.groups for n in g}, str(found)
    assert [r.get("joined") for r in found.check] == [None, True, None]
    assert all(r["rms_after"] < 1.5 * r["noise_rms"] for r in found.check)
    assert dataclasses.asdict(found)["message"].endswith("it joined them.")
