"""Emf of a pick-up coil to flux density, and captures joined: answers known in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

from magjax.errors import RecordingError
from magjax.pickup import integrate_emf, merge_captures, without_strays

TURNS, AREA, F = 75, 2e-6, 50.0
COIL = {"emf_turns": TURNS, "emf_area": AREA}
LINES = ((1, 1.2, 0.0), (3, -0.2, 0.4), (7, 0.03, 1.0))  # order, T, rad
BENCH = SimpleNamespace(drive="field", columns={"flux_density": COIL})


def flux(time):
    """B(t), T, zero mean."""
    return sum(B * np.sin(2 * np.pi * F * h * time + angle) for h, B, angle in LINES)


def emf(time):
    """-N A dB/dt, V."""
    pace = 2 * np.pi * F
    return -TURNS * AREA * sum(B * h * pace * np.cos(h * pace * time + angle) for h, B, angle in LINES)


def drive(time):
    """Field of the magnetizing coil, A/m; its crest is at (pi/2 - 0.3) / (2 pi F)."""
    return 800 * np.sin(2 * np.pi * F * time + 0.3)


CREST = (np.pi / 2 - 0.3) / (2 * np.pi * F)


# samples a period and periods, whole or not
@pytest.mark.parametrize(("per", "periods"), [(200, 4), (200, 3.37), (173.3, 4.6), (41.7, 6), (200, 1)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_integral_of_an_emf_is_exact_at_any_sampling(per, periods, sign):
    """An offset, which summed would drift by 40 T/s, leaves nothing."""
    dt = 1 / (F * per)
    time = dt * np.arange(round(per * periods))
    got = integrate_emf(-sign * emf(time) + 6e-3, drive(time), dt, COIL | {"emf_sign": sign})
    assert np.abs(got - flux(time)).max() < 1e-12


def test_a_drift_of_the_emf_leaves_an_arc_with_level_ends():
    """An offset that grows at 1 mV/s would lead B 53 mT away; what stays is the parabola that closes, 5.3 mT high."""
    dt, slope = 1 / (F * 200), 1e-3
    time = dt * np.arange(800)
    error = integrate_emf(emf(time) + 6e-3 + slope * time, drive(time), dt, COIL) - flux(time)
    arc = 0.5 * slope * time * (time[-1] - time) / (TURNS * AREA)
    assert np.ptp(arc) == pytest.approx(5.3e-3, rel=0.01)
    assert np.abs(error - (arc - arc.mean())).max() < 1e-6


def test_noise_of_the_emf_is_that_of_a_walk_with_level_ends():
    """White noise sums to a random walk; level at its ends and without its mean, its rms is 1/sqrt(12) of the end's spread."""
    dt, noise = 1 / (F * 200), 2e-3  # V
    time = dt * np.arange(800)
    errors = [
        integrate_emf(emf(time) + noise * np.random.default_rng(k).standard_normal(800), drive(time), dt, COIL) - flux(time)
        for k in range(40)
    ]
    walk = noise * dt * np.sqrt(800) / (TURNS * AREA)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(walk / np.sqrt(12), rel=0.15)


def test_an_emf_without_a_period_is_summed():
    dt = 1 / (F * 400)
    time = dt * np.arange(600)
    rise = 800 * time  # a drive that does not return
    got = integrate_emf(np.full(600, 1e-3), rise, dt, COIL)
    assert np.abs(got).max() < 1e-12  # an offset alone
    step = np.where(time < 0.5 * time[-1], -1.0, 1.0) * -TURNS * AREA  # dB/dt of -1, then +1 T/s: a V
    got = integrate_emf(step, rise, dt, COIL)
    bend = np.abs(time - 0.5 * time[-1])
    assert np.abs(got - (bend - bend.mean())).max() < 2 * dt


def capture(start, count, per, offset, missing=(), noise=0.0, seed=0):
    """One capture of field and emf that begins anywhere, with an offset of its own and samples that are not there."""
    time = start + np.arange(count) / (F * per)
    rng = np.random.default_rng(seed)
    channels = {"field": drive(time), "flux_density": emf(time) + offset + noise * rng.standard_normal(count)}
    keep = np.setdiff1d(np.arange(count), missing)
    return {"time": (time - start)[keep], **{q: v[keep] for q, v in channels.items()}}


def test_captures_are_joined_at_the_crest_of_the_drive():
    """Three captures, each begun elsewhere, one sampled otherwise, with gaps: whole periods, without offset, in phase."""
    captures = [
        capture(0.0013, 500, 200, 4e-3),
        capture(0.0101, 510, 200, -3e-3, missing=range(120, 140)),
        capture(0.0167, 640, 203, 1e-3),
    ]
    merged, filled = merge_captures(captures, BENCH, "rod.csv")
    periods = len(merged["time"]) // 200
    assert periods == 5 and filled == 20
    phase = np.arange(200 * periods) / (200 * F)
    assert merged["time"] == pytest.approx(phase, abs=1e-12)
    assert np.abs(merged["field"] - drive(CREST + phase)).max() < 1e-4 * 800
    expected = emf(CREST + phase)
    assert np.abs(merged["flux_density"] - expected).max() < 2e-4 * np.abs(expected).max()
    B = integrate_emf(merged["flux_density"], merged["field"], merged["time"][1], COIL)
    assert np.abs(B - flux(CREST + phase)).max() < 2e-4


def test_noise_of_captures_stays_what_it_is():
    """Joining keeps the samples of each capture, it does not smooth them; their harmonics come back as the noise allows."""
    noise = 2e-3
    captures = [capture(0.0007 * k, 500, 200, 1e-3 * k, noise=noise, seed=k) for k in range(6)]
    merged, _ = merge_captures(captures, BENCH, "rod.csv")
    phase = np.arange(len(merged["time"])) / (200 * F)
    left = merged["flux_density"] - emf(CREST + phase)
    assert 0.75 * noise < left.std() < 1.05 * noise  # a spline between two samples lessens it
    tone = 2 * np.mean(left * np.exp(-2j * np.pi * F * phase))
    assert abs(tone) < 4 * noise * np.sqrt(2 / len(left))


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda c: c["field"].put(100, np.nan), "NaN"),
        (lambda c: c["field"].put(np.arange(500), np.random.default_rng(0).standard_normal(500)), "does not repeat"),
        (lambda c: c["time"].put(np.arange(400, 500), c["time"][400:] + 0.3e-4), "uniform"),
    ],
)
def test_a_capture_that_cannot_be_joined_is_named(spoil, word):
    captures = [capture(0.0, 500, 200, 0.0), capture(0.002, 500, 200, 0.0)]
    spoil(captures[1])
    with pytest.raises(RecordingError, match=f"rod.csv.*capture 1.*{word}"):
        merge_captures(captures, BENCH, "rod.csv")


def run_of(per=200.0, periods=4, seed=0):
    """Drive and reading with an edge that repeats, a little noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(per * periods)) / (per * F)
    reading = flux(time) + 0.2 * np.tanh(40 * np.sin(2 * np.pi * F * time)) + 1e-3 * rng.standard_normal(len(time))
    return time, {"current": drive(time) / 800 + 1e-4 * rng.standard_normal(len(time)), "displacement": reading}


@pytest.mark.parametrize("per", [200.0, 173.3])
def test_single_samples_far_off_are_put_where_their_harmonics_are(per):
    time, clean = run_of(per)
    struck = {q: v.copy() for q, v in clean.items()}
    for at, by in ((101, 0.9), (102, 0.7), (555, -0.4)):
        struck["displacement"][at] += by
    struck["current"][0] -= 3.0
    mended, counts = without_strays(time, struck, "current")
    assert counts == {"current": 1, "displacement": 3}
    assert np.abs(mended["displacement"] - clean["displacement"]).max() < 0.05
    assert np.abs(mended["current"] - clean["current"]).max() < 1e-3
    there = np.ones(len(time), bool)
    there[[101, 102, 555]] = False
    assert np.array_equal(mended["displacement"][there], clean["displacement"][there])  # all others are as they were
    assert without_strays(time, mended, "current") == (mended, {})


@pytest.mark.parametrize("what", ["nothing", "repeats", "many", "wide", "two periods", "too small"])
def test_what_else_stands_out_stays(what):
    time, channels = run_of(periods=2 if what == "two periods" else 4)
    places = {
        "nothing": [], "repeats": [60, 260, 460, 660], "many": range(40, 700, 60), "wide": range(300, 305), "two periods": [50],
        "too small": [50],
    }[what]  # fmt: skip
    for at in places:
        channels["displacement"][at] += 0.005 if what == "too small" else 0.8
    mended, counts = without_strays(time, channels, "current")
    assert mended is channels or all(mended[q] is channels[q] for q in channels)
    assert counts == {}


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_file_with_strays_is_mended_where_it_is_read_and_says_so(tmp_path, number):
    from fitting.outcome import strayed
    from magjax.bench import load_bench
    from magjax.inspection import inspect
    from magjax.readers import load_recordings

    time, channels = run_of(200.0)
    current, reading = channels["current"], 2e-5 + 1e-5 * channels["displacement"]
    for at in (333, 444)[:number]:
        reading[at] += 3e-5
    path = tmp_path / "run.csv"
    rows = "\n".join(f"{t:.9g},{i:.9g},{y:.9g}" for t, i, y in zip(time, 0.5 * current, reading, strict=True))
    path.write_text(f"time_s,current_A,displacement_m\n{rows}\n")
    bench = load_bench("aa-050h")
    (recording,) = load_recordings([path], bench)
    assert np.ptp(recording.channels["displacement"]) < 3.5e-5
    card = inspect(recording, bench)
    said = [w for w in card.warnings if "far off alone" in w]
    assert len(said) == (number > 0) and not card.problems
    if number:
        assert said[0].startswith(f"{number} sample") and "displacement" in said[0]
    assert strayed([recording]) == (f"; samples that stood far off alone were left out: run.csv ({number})" if number else "")
