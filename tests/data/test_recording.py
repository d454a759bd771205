"""A recording's own judgements: period, noise from repeats, what is refused and what is not."""

import dataclasses

import numpy as np
import pytest

from magjax.bench import load_bench
from magjax.errors import RecordingError
from magjax.inspection import inspect
from magjax.readers import read_file
from magjax.recording import Recording, fundamental, load_recordings
from magjax.waveforms import modulated_sine, multisine, sine


def made(drive, noise=1e-8, seed=0, extra=0.0):
    rng = np.random.default_rng(seed)
    y = 2e-5 + 1e-5 * drive.values + extra + noise * rng.standard_normal(len(drive.values))
    return Recording(drive.time, {"current": drive.values, "displacement": y})


@pytest.mark.parametrize(
    "drive",
    [sine(7.3, 0.5, 0.1, samples=217), multisine([20, 50, 70], 0.4, periods=3), modulated_sine(60, 6, 0.4, depth=0.5, periods=3),
     modulated_sine(300, 10, 0.4, periods=2, samples=3000)],
    ids=lambda d: d.name,
)  # fmt: skip
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_the_period_of_the_whole_drive_is_found(drive, noise):
    values = drive.values + noise * np.random.default_rng(2).standard_normal(len(drive.values))
    assert fundamental(values, drive.dt) == pytest.approx(drive.frequency, rel=2e-4 if noise else 1e-6)


def test_periods_need_not_divide_the_sampling():
    t = np.arange(1300) / 1000
    recording = Recording(t, {"current": np.sin(2 * np.pi * 7.31 * t), "displacement": 1e-5 * np.cos(2 * np.pi * 7.31 * t)})
    assert recording.frequency() == pytest.approx(7.31, rel=1e-5)
    assert recording.period_samples() == pytest.approx(1000 / 7.31, rel=1e-5)
    assert recording.repeats("displacement").shape == (9, 137) and recording.repeat_noise("displacement") < 1e-9


def test_noise_is_found_from_repeats():
    assert made(sine(10, 0.5, samples=500), 3e-8).repeat_noise("displacement") == pytest.approx(3e-8, rel=0.06)
    one = made(sine(10, 0.5, periods=1))
    assert one.repeat_noise("displacement") is None and one.is_periodic and one.periods() == pytest.approx(1)


def test_what_runs_once_has_no_period():
    t = np.arange(1000) * 1e-3
    recording = Recording(t, {"current": t**2, "displacement": 1e-5 * t})
    assert not recording.is_periodic and recording.period_samples() is None
    assert recording.repeat_noise("current") is None and recording.duration == pytest.approx(1.0) and recording.n_samples == 1000


def test_a_round_crest_is_not_clipped_but_a_flat_top_is():
    smooth = sine(10, 0.5, samples=4000)
    made(smooth, 0.0)
    noise = 1e-8 * np.random.default_rng(0).standard_normal(len(smooth.values))
    y = np.minimum(1e-5 * smooth.values + noise, 4e-6)
    with pytest.raises(RecordingError, match="displacement is clipped at its highest value"):
        Recording(smooth.time, {"current": smooth.values, "displacement": y})


def test_a_small_jitter_passes_and_a_jump_is_placed():
    drive = sine(10, 0.5, samples=100)
    time = drive.time + 0.05 * drive.dt * np.random.default_rng(0).uniform(-1, 1, len(drive.time))
    Recording(time, {"current": drive.values, "displacement": drive.values})
    time[200:] += 0.5
    with pytest.raises(RecordingError, match="sample 200"):
        Recording(time, {"current": drive.values, "displacement": drive.values})


@pytest.mark.parametrize("unit, scale", [("current_mA,displacement_um", (1e3, 1e6)), ("current_A,displacement_mm", (1, 1e3))])
def test_units_in_names_become_si(tmp_path, unit, scale):
    original = made(sine(10, 0.5, samples=100))
    rows = np.stack([original.time * 1e3, original.channels["current"] * scale[0], original.channels["displacement"] * scale[1]], 1)
    path = tmp_path / "r.csv"
    np.savetxt(path, rows, delimiter=",", header=f"# date: today\ntime_ms,{unit}", comments="", fmt="%.12g")
    got = load_recordings([path], "aa-050h")[0]
    assert got.channels["displacement"] == pytest.approx(original.channels["displacement"], rel=1e-9)
    assert got.channels["current"] == pytest.approx(original.channels["current"], abs=1e-10) and got.dt == pytest.approx(
        original.dt
    )
    assert got.origin["metadata"]["date"] == "today" and len(got.origin["sha256"]) == 64


def test_a_raw_log_that_cannot_be_read_is_one_line(tmp_path):
    path = tmp_path / "run.mjlog"
    path.write_bytes(b"not a log")
    with pytest.raises(RecordingError) as error:
        read_file(path, load_bench("aa-050h"))
    assert "\n" not in str(error.value)


def test_check_sees_a_transient_and_a_drift():
    drive = sine(10, 0.5, samples=200, periods=5)
    bench = load_bench("aa-050h")
    assert not inspect(made(drive), bench).problems
    assert "transient" in " ".join(inspect(made(drive, extra=3e-6 * np.exp(-drive.time / 0.02)), bench).problems)
    assert "drifts" in " ".join(inspect(made(drive, extra=1e-5 * drive.time), bench).problems)


def test_measured_loop_families_load_closed(measured):
    for name, count, top in (("steel_m130_27s", 3, 217.0), ("ferrite_mnzn", 4, 80.0)):
        loops = load_recordings([measured / name / "loops.csv"], "material-loops")
        assert len(loops) == count
        assert max(np.max(r.channels["field"]) for r in loops) == pytest.approx(top, rel=0.01)
        for loop in loops:
            B = loop.channels["flux_density"]
            assert abs(B[0] - B[-1]) < 0.03 * np.ptp(B) and loop.frequency() == pytest.approx(1.0)


def test_a_single_sample_is_told(tmp_path):
    path = tmp_path / "one.csv"
    path.write_text("time_s,current_A,displacement_m\n0,0.1,1e-5\n")
    with pytest.raises(RecordingError, match="one sample only"):
        load_recordings([path], load_bench("aa-050h"))


def test_the_fundamental_is_looked_for_once(monkeypatch):
    from magjax import recording as module

    asked, look = [], module.fundamental
    monkeypatch.setattr(module, "fundamental", lambda *given: asked.append(given) or look(*given))
    time = np.arange(1000) * 1e-3
    one = Recording(time, {"current": np.sin(2 * np.pi * 5 * time), "displacement": np.cos(2 * np.pi * 5 * time)})
    assert one.frequency() == pytest.approx(5) and one.periods() == pytest.approx(5) and not one.noise_is_a_guess("displacement")
    assert len(asked) == 1
    other = dataclasses.replace(one, channels={**one.channels, "current": np.sin(2 * np.pi * 8 * time)})
    assert other.frequency() == pytest.approx(8) and len(asked) == 2


def test_what_is_made_of_a_recording_is_not_judged_as_measured():
    """A rod with play rests at its crests: read as sound, and refused as clipped once a slow drift had been taken out of it."""
    time = np.arange(1000) * 1e-3
    x = np.sin(2 * np.pi * 5 * time)
    one = Recording(time, {"current": x, "displacement": np.cos(2 * np.pi * 5 * time)})
    cut = {"current": x, "displacement": np.minimum(one.channels["displacement"], 0.7)}
    with pytest.raises(RecordingError, match="clipped"):
        Recording(time, cut)
    assert dataclasses.replace(one, channels=cut).judged


@pytest.mark.parametrize("noise", [0.0, 2e-3])
@pytest.mark.parametrize("weaker", [0.08, 0.2, 0.35])
@pytest.mark.parametrize("periods", [1, 2, 5])
def test_what_differs_from_period_to_period_belongs_to_a_longer_one(periods, weaker, noise):
    """10 and 17.5 Hz were read as 9.92 Hz where the record held 0.4 s, what differs as its noise: 2.7 um for 36 nm."""
    rng, t = np.random.default_rng(3), np.arange(1000 * periods) / 2500
    x = np.sin(2 * np.pi * 10 * t) + weaker * np.sin(2 * np.pi * 17.5 * t + 0.3) + noise * rng.standard_normal(len(t))
    assert fundamental(x, 1 / 2500) == pytest.approx(2.5, rel=1e-4)


@pytest.mark.parametrize("periods", [3, 4])
def test_a_drive_with_noise_or_a_trend_of_its_own_keeps_its_period(periods):
    rng, t = np.random.default_rng(5), np.arange(400 * periods) / 4000
    for else_ in (0.1 * rng.standard_normal(len(t)), 0.2 * np.exp(-t / 0.05), 0.04 * np.sin(2 * np.pi * 50 * t)):
        assert fundamental(np.sin(2 * np.pi * 10 * t) + else_, 1 / 4000) == pytest.approx(10.0, rel=5e-3)


@pytest.mark.parametrize("orders", [(3, 7, 11, 13, 17, 19, 23, 27, 31, 33, 37), (3, 5, 8, 12, 17, 23, 30)], ids=len)
def test_the_period_of_a_multisine_is_not_drawn_off_by_its_weaker_lines(orders):
    """With the five strongest of them alone it was 8e-5 off, which turns the 37th order by 4 degrees within four periods."""
    rng, phase = np.random.default_rng(4), np.arange(4 * 1600) / 1600
    x = 0.05 + sum(0.09 * np.sin(2 * np.pi * (k * phase + rng.random())) for k in orders)
    assert fundamental(x, 1 / (1600 * 7.0)) == pytest.approx(7.0, rel=1e-9)
