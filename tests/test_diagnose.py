"""The diagnosis on concealed benches: silence on a null, the right name, the data's own problems."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import fitting.diagnose as module
from fitting.demo import concealed_actuator, record
from fitting.diagnose import diagnose
from fitting.floors import data_problem
from fitting.placebo import placebo
from fitting.setup import Choices, spectra_of
from magjax.bench import load_bench
from magjax.effects import CATALOGUE, SensorLag
from magjax.recording import Recording

DRIVES = ((10, 0.8, 0.1), (50, 0.5, -0.2), (120, 0.8, 0.1), (200, 0.5, -0.2), (300, 0.8, 0.1))


@pytest.fixture(scope="module")
def bench():
    return load_bench("aa-050h")


def study(bench, effect=None, seed=5):
    rng = np.random.default_rng(seed)
    truth = concealed_actuator(bench, effect)
    return [record(truth, *d, rng, f"r{d[0]}") for d in DRIVES], [record(truth, 400, 0.6, 0.05, rng, "c400")]


def test_silent_where_nothing_is_missing(bench):
    runs, checks = study(bench)
    found = diagnose(runs, bench, check=checks, choices=Choices(fine=250), placebo_runs=2)
    assert found.verdict == "nothing_missing" and "A wrong c0, H_bias or lambda_s in" in str(found)
    assert found.placebo["runs"] == 2 and found.placebo["false_alarms"] == 0 and 0 < max(found.placebo["highest_z"]) < 5.5
    low = placebo(found.base, 1e-3, 1)  # everything scores above nothing
    assert low["false_alarms"] == 1 and sum(low["named"].values()) == 1
    assert not found.effects and not found.groups and found.repaired is None
    assert {"linear_strain", "mean_field", "reversible_magnetization"} <= set(found.absorbed)
    assert max(abs(c.z) for c in found.candidates) < 5.5
    content = found.as_dict()
    assert {"verdict", "effects", "groups", "rivals", "absorbed", "unknown", "data_problem", "candidates", "floors", "where", "check",
            "next_experiment", "placebo", "message", "base", "repaired"} == set(content)  # fmt: skip


def test_names_a_concealed_sensor_filter(bench):
    runs, checks = study(bench, SensorLag(tau=1e-4, order2=0.5))
    asked = {"sensor_lag", "amplifier_lag", "transport_delay", "duffing_stiffness"}  # all of it: the blind suites
    others = tuple(e.name for e in CATALOGUE if e.name not in asked)
    found = diagnose(runs, bench, check=checks, choices=Choices(fine=250, without=others))
    assert found.verdict == "attributed"
    (effect,) = found.effects
    assert effect["name"] == "sensor_lag"
    assert effect["parameters"]["tau"]["value"] == pytest.approx(1e-4, rel=0.05)
    row = found.check[0]
    assert row["rms_before"] > 3 * row["noise_rms"] and row["rms_after"] < 1.4 * row["noise_rms"]
    before, after = effect["shifts"]["mechanics.f0"]
    assert abs(after - 405) < 0.2 * abs(before - 405)


@pytest.mark.parametrize("inside", ["the first fit", "trials side by side"])
def test_ctrl_c_ends_a_diagnosis(bench, inside):
    runs, _ = study(bench, SensorLag(tau=1e-4, order2=0.5))
    others = tuple(e.name for e in CATALOGUE if e.name not in {"sensor_lag", "mean_field", "duffing_stiffness"})
    said = []

    def stop(text, step, chi2):
        said.append(text)
        if step == 2 and (inside == "the first fit" or any(t.startswith("trying") for t in said)):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        diagnose(runs[:3], bench, choices=Choices(fine=250, without=others), progress=stop)
    assert any(" and " in t for t in said) == (inside != "the first fit")


def test_a_transient_is_a_data_problem(bench):
    runs, _ = study(bench)
    run = runs[1]
    t = run.time
    spoiled = run.channels["displacement"] + 8e-6 * np.exp(-t / (0.2 / 50))
    bad = Recording(t, {**run.channels, "displacement": spoiled}, {}, run.origin, "unsettled")
    text = data_problem([bad], spectra_of([bad], bench), "displacement")
    assert text is not None and "transient" in text


def test_a_drift_by_the_root_of_time_is_no_transient(bench):
    runs, _ = study(bench)
    run = runs[1]
    y = run.channels["displacement"]
    drifting = y + 0.06 * np.ptp(y) * np.sqrt(run.time / run.time[-1])
    again = Recording(run.time, {**run.channels, "displacement": drifting}, {}, run.origin, "drifting")
    (s,) = spectra_of([again], bench)
    period = int(s.samples / s.periods)
    assert np.sqrt(np.mean((drifting[:period] - drifting[-period:]) ** 2)) > 0.03 * np.ptp(y)  # by itself it would be one
    assert data_problem([again], [s], "displacement") is None


def test_a_slow_decay_in_every_recording_is_a_data_problem(bench):
    """Ringing off the harmonics for two periods, in every recording: a straight drift and a raised noise must not take it."""
    runs, _ = study(bench)
    bad = []
    for run in runs:
        f, y = run.frequency(), run.channels["displacement"]
        ring = 0.04 * np.ptp(y) * np.exp(-run.time * f / 1.5) * np.cos(2 * np.pi * 0.37 * f * run.time)
        bad.append(Recording(run.time, {**run.channels, "displacement": y + ring}, {}, run.origin, run.name))
    text = data_problem(bad, spectra_of(bad, bench), "displacement")
    assert text is not None and "in most recordings" in text
    assert data_problem(runs, spectra_of(runs, bench), "displacement") is None


def test_periods_that_do_not_divide_are_no_data_problem():
    bench = load_bench("aa-050h")
    rng = np.random.default_rng(2)
    t = np.arange(900) / 20000.0
    current = 0.5 * np.sin(2 * np.pi * 101.3 * t)
    y = 3e-5 + 1e-5 * current + 3e-6 * current**3 + 4e-8 * rng.standard_normal(len(t))
    run = Recording(t, {"current": current, "displacement": y}, name="free-running clock")
    assert data_problem([run], spectra_of([run], bench), "displacement") is None


def test_a_swapped_sign_is_a_data_problem(bench):
    runs, _ = study(bench)
    swapped = [
        Recording(r.time, {**r.channels, "displacement": 6e-5 - r.channels["displacement"]}, {}, r.origin, r.name) for r in runs
    ]
    found = diagnose(swapped, bench, choices=Choices(fine=250, max_jacobians=8))
    assert found.verdict == "data_problem" and "sign" in found.message


@pytest.mark.long
def test_quasistatic_loops_claim_no_rate_effect(measured):
    from magjax.recording import load_recordings

    bench = load_bench("material-loops")
    found = diagnose(load_recordings([measured / "ferrite_mnzn" / "loops.csv"], bench), bench, choices=Choices(max_jacobians=12))
    static = {"mean_field", "reversible_magnetization", "accommodation", "sensor_nonlinearity"}
    assert {e["name"] for e in found.effects} | {n for g in found.groups for n in g} <= static


def test_periods_that_do_not_repeat_are_a_data_problem():
    """A slowly decaying start that is alike in every recording, however short: no drift does that."""
    bench = load_bench("aa-050h")
    rng = np.random.default_rng(0)
    for size, wrong in ((0.04, True), (0.0, False)):
        recordings = []
        for f in (10.0, 100.0, 300.0):
            t = np.arange(2000) / (500 * f)
            wave = np.sin(2 * np.pi * f * t)
            y = 3e-5 + 2e-5 * wave * (1 + size * 2 * np.linspace(1, 0, 2000)) + 40e-9 * rng.standard_normal(2000)
            y = y + (2e-6 * t if not wrong else 0)  # a real drift is no data problem
            recordings.append(Recording(t, {"current": 0.5 * wave, "displacement": y}, {}, {}, f"{f} Hz"))
        found = data_problem(recordings, spectra_of(recordings, bench), "displacement")
        assert (found is not None and "do not repeat" in found) == wrong


def test_a_sensors_zero_is_adopted_where_it_scores_best_and_told_of_where_an_effect_does_as_well(bench, monkeypatch):
    rng = np.random.default_rng(3)
    truth, zero = concealed_actuator(bench), 6e-6
    runs = [
        record(truth, *drive, rng, f"r{drive[0]}") for drive in ((10, 0.8, 0.1), (50, 0.5, -0.2), (150, 0.8, 0.1), (300, 0.5, 0.0))
    ]
    runs = [dataclasses.replace(r, channels={**r.channels, "displacement": r.channels["displacement"] + zero}) for r in runs]
    base = module.fit(runs, bench, refine=False)
    monkeypatch.setattr(module, "screened", lambda result, choices: [])
    asked = (None, (), base.choices, None)
    score = abs(module.offset_score(base.problem, base.refined))
    assert score > 8
    rival = SimpleNamespace(z=1.02 * score)
    same, candidates, none, told = module._sensor_zero(runs, bench, base, [rival], *asked)
    assert same is base and candidates == [rival] and none is None and told == pytest.approx(zero, abs=1.2e-6)
    freed, _, found, none = module._sensor_zero(runs, bench, base, [SimpleNamespace(z=0.5 * score)], *asked)
    assert found == pytest.approx(zero, abs=1.2e-6) and none is None and freed.chi2_per_sample < base.chi2_per_sample
    better = module._sensor_zero(runs, bench, base, [SimpleNamespace(z=2 * score)], *asked)
    assert better[0] is base and better[2:] == (None, None)
