"""Clipped crests are told from honest ones: round, saturating, held, noisy, coarsely counted."""

import dataclasses

import numpy as np
import pytest

from magjax.bench import load_bench
from magjax.clipping import clipped_crest, cut_in_noise, quantum, refuse_clipping, stuck_stretch
from magjax.errors import RecordingError
from magjax.formats import read_csv
from magjax.readers import load_recordings, load_sound
from magjax.recording import Recording

BITS = (8, 12, 16, None)


def counted(x, bits):
    """As a converter reads it whose range is +-1."""
    return x if bits is None else np.round(x * 2 ** (bits - 1)) / 2 ** (bits - 1)


def phases(samples, periods=3.37):
    return np.arange(int(samples * periods)) / samples


def is_clipped(x):
    return any(f(side) is not None for f in (clipped_crest, cut_in_noise) for side in (x, -x))


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("share", [0.9, *(pytest.param(s, marks=pytest.mark.long) for s in (0.7, 0.5))])
@pytest.mark.parametrize("noise", [0.0, pytest.param(1e-5, marks=pytest.mark.long), 1e-4, 1e-3])
@pytest.mark.parametrize("sides", ["top", "both"])
@pytest.mark.parametrize("noisy", ["before", "after"])
def test_a_cut_sine_is_clipped(bits, share, noise, sides, noisy):
    rng = np.random.default_rng(1)
    for samples in (200, 2000):
        sine = np.sin(2 * np.pi * phases(samples))
        low, high = (-np.inf, 2 * share - 1) if sides == "top" else (-share, share)
        e = noise * rng.standard_normal(len(sine))
        x = np.clip(sine + e, low, high) if noisy == "before" else np.clip(sine, low, high) + e
        assert is_clipped(counted(x, bits)), samples


@pytest.mark.parametrize("start", [0.0, 0.25, 0.6])
def test_one_period_suffices_wherever_it_begins(start):
    x = np.minimum(np.sin(2 * np.pi * (phases(400, 1) + start)), 0.8)
    first, length = clipped_crest(x)
    at = (first + np.arange(length)) % len(x)
    assert np.all(x[at] == 0.8) and length == np.sum(x == 0.8)


@pytest.mark.parametrize("phase", np.arange(8) / 8)
def test_fringes_that_fold_a_crest_are_no_limit(phase):
    """An interferometer's error of a quarter of its period: the crest is flat but for hills that come back with every period."""
    rng = np.random.default_rng(3)
    motion = 20 * np.sin(2 * np.pi * phases(1000, 4))
    reading = motion + 0.4 * np.sin(2 * np.pi * (motion / 1.6 + phase)) + 0.04 * rng.standard_normal(len(motion))
    assert not is_clipped(reading)
    assert is_clipped(np.minimum(motion, 14.0) + 0.04 * rng.standard_normal(len(motion)))


def honest(t):
    """Periodic signals that nothing cut, by name."""
    s = np.sin(2 * np.pi * t)
    triangle = 2 / np.pi * np.arcsin(s)
    signals = {"sine": s, "triangle": triangle, "crest of fourth order": 1 - 2 * np.sin(np.pi * t) ** 4}
    signals |= {"third harmonic": (s + np.sin(6 * np.pi * t) / 9) / 0.95}
    signals |= {f"tanh {a}": np.tanh(a * s) / np.tanh(a) for a in (1, 1.5, 2, 3, 5, 10, 30)}
    signals |= {f"arctan {a}": np.arctan(a * s) / np.arctan(a) for a in (2, 5, 20)}
    signals |= {f"magnetostriction {a}": 2 * np.tanh(a * s + 0.7) ** 2 - 1 for a in (2, 5)}
    signals |= {f"trapezoid {a}": np.clip(a * triangle, -1, 1) for a in (1.7, 5)}
    signals |= {"square": np.where(s >= 0, 1.0, -1.0), "staircase": np.round(3 * s) / 3}
    signals |= {"ramped staircase": np.interp(t % 1.0, np.arange(13) / 12, np.array([0, 0, 1, 1, 3, 3, 1, 1, 0, 0, -3, -3, 0]) / 3)}
    signals |= {"held crest": np.sin(np.pi / 2 * np.clip(2 * triangle, -1, 1))}
    signals |= {"three tones": sum(np.sin(2 * np.pi * (h * t + 0.16 * h)) for h in (2, 5, 7)) / 3}
    return signals | {"modulated": np.sin(6 * np.pi * t) * (1 + 0.6 * np.cos(2 * np.pi * t)) / 1.6}


@pytest.mark.parametrize("noises", [(0.0, 1e-4, 2e-3, 1e-2), pytest.param((1e-5, 1e-3, 5e-3, 3e-2), marks=pytest.mark.long)], ids=["some", "more"])
@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", honest(phases(8)))
def test_what_nothing_cut_is_not_clipped(name, bits, noises):
    rng = np.random.default_rng(2)
    for samples in (200, 2000):
        for periods in (1, 3.37):
            for noise in noises:
                x = honest(phases(samples, periods))[name]
                assert not is_clipped(counted(x + noise * rng.standard_normal(len(x)), bits)), (samples, periods, noise)


def test_a_reading_that_rests_with_its_drive_is_not_clipped():
    t = phases(400, 4)
    drive = np.clip(3.4 / np.pi * np.arcsin(np.sin(2 * np.pi * t)), -1, 1)
    reading = 1e-5 * (drive + 0.3 * drive**2)  # curved flanks, corners, flat where the drive is held
    Recording(t, {"current": drive, "displacement": reading})
    with pytest.raises(RecordingError, match="displacement is clipped"):
        Recording(t, {"current": np.sin(2 * np.pi * t), "displacement": reading})


def bottoms(drift, limit=-np.inf, seed=0):
    """Bottoms as flat as that of a strain whose M stays near zero for a third of the period, on a zero that drifts by so much in five
    periods; a converter ends at the limit."""
    t = phases(100, 5)
    x = np.maximum(np.sin(2 * np.pi * t), -0.6) + drift * t / t[-1] + 2e-3 * np.random.default_rng(seed).standard_normal(len(t))
    return np.maximum(x, limit)


@pytest.mark.parametrize("seed", range(6))
def test_bottoms_as_flat_at_levels_of_their_own_are_no_limit(seed):
    """A strain turns at zero magnetization, and its zero drifts; a limit stays where it is."""
    assert clipped_crest(-bottoms(0.02, seed=seed)) is None
    assert clipped_crest(-bottoms(0.0, seed=seed)) is not None
    assert is_clipped(bottoms(0.02, limit=-0.585, seed=seed))


def test_a_lower_crest_that_is_cut_less_leaves_the_limit_a_limit():
    """Of two tones, the lower crests are round: they are no plateaus of their own."""
    t = phases(200, 10)
    two = (1 + 0.3 * np.sin(2 * np.pi * t / 5)) * np.sin(2 * np.pi * t)
    assert is_clipped(np.minimum(two, 0.95) + 2e-3 * np.random.default_rng(0).standard_normal(len(t)))


@pytest.mark.parametrize(("low", "hold", "rise", "top"), [(0.97, 35, 12, 80), (0.985, 50, 12, 100), (0.95, 50, 16, 100)])
def test_a_play_holds_below_its_crest_and_on_it(low, hold, rise, top):
    """Behind a play the reading of a rod that rings at its crest holds, steps up and holds again: a strong backlash was refused as clipped."""
    k = np.arange(500)

    def step(begin, length):
        u = np.clip((k - begin) / length, 0, 1)
        return u * u * (3 - 2 * u)

    falls = np.clip((k - 110 - hold - rise - top) / 90, 0, 1)
    period = (1 + low) * step(60, 50) + (1 - low) * step(110 + hold, rise) - 1 - 2 * np.sin(np.pi / 2 * falls) ** 1.2
    reading = np.tile(period, 4) + 7e-4 * np.random.default_rng(0).standard_normal(2000)
    assert not is_clipped(reading) and is_clipped(np.minimum(reading, 0.5))


def test_noise_after_the_cut_does_not_hide_it():
    t = phases(400, 4)
    y = np.minimum(1e-5 * np.sin(2 * np.pi * t), 8e-6) + 1e-9 * np.random.default_rng(0).standard_normal(len(t))
    with pytest.raises(RecordingError, match="clipped at its highest value"):
        Recording(t, {"current": np.sin(2 * np.pi * t), "displacement": y})


@pytest.mark.parametrize("bits", [16, None])
def test_crests_cut_with_their_noise_by_little_are_clipped(bits):
    noise = 1e-3 * np.random.default_rng(4).standard_normal(4000)
    x = np.sin(2 * np.pi * phases(1000, 4)) + noise
    level = np.quantile(x, 0.93)  # noise of a third of what is cut off: no plateau is whole
    assert is_clipped(counted(np.minimum(x, level), bits)) and not is_clipped(counted(x, bits))


@pytest.mark.parametrize("bits", [16, None])
@pytest.mark.parametrize("below", [0.02, 0.03, 0.05, 0.08, 0.15])
def test_a_saturated_crest_cut_with_its_noise_is_clipped(below, bits):
    """More than a third of the samples at the limit hid how far the others scatter."""
    noise = 7e-4 * np.random.default_rng(4).standard_normal(4000)
    x = 0.45 * np.tanh(2 * np.sin(2 * np.pi * phases(1000, 4)) + 1) + noise
    assert is_clipped(counted(np.minimum(x, x.max() - below * np.ptp(x)), bits)) and not is_clipped(counted(x, bits))


@pytest.mark.parametrize("samples", [12, 20, 50, 200])
def test_a_sine_without_noise_reaches_its_crest_in_every_period(samples):
    x = np.sin(2 * np.pi * (np.arange(40 * samples) % samples) / samples)
    x[7 * samples : 7 * samples + 2] += 1e-3
    assert np.sum(x == x.max()) >= 40 and not is_clipped(x) and stuck_stretch(x) is None


def test_few_counts_on_a_small_sine_are_no_plateau():
    step = 2.0 / 2**15
    x = -0.3 + 0.274 * np.sin(2 * np.pi * (phases(1000, 4)))  # seven samples on one count at its lowest
    x = np.round(np.round(x / step) * step, 7)
    assert quantum(x) == pytest.approx(step, rel=1e-3) and not is_clipped(x)


@pytest.mark.parametrize("bits", [12, 16, None])
def test_a_converter_that_hangs_is_told(bits):
    noise = 1e-3 * np.random.default_rng(5).standard_normal(2000)
    x = counted(0.8 * np.sin(2 * np.pi * phases(500, 4)) + noise, bits)
    assert stuck_stretch(x) is None
    x[1100:1140] = x[1100]
    assert stuck_stretch(x) == (1100, 40)
    with pytest.raises(RecordingError, match="stands still at .*m for 40 samples from sample 1100") as error:
        refuse_clipping("run.csv", "displacement", x)
    assert (error.value.shown["first"], error.value.shown["length"]) == (1100, 40)


@pytest.mark.parametrize("step, levels", [(15, [0, 15, 29, 44, 58, 73]), (3, [0, 9, 12, 21, 30]), (1, range(200))])
def test_the_count_of_a_converter_is_found(step, levels):
    expected = {15: 1, 3: 3, 1: 1}[step]
    assert quantum(0.02 * np.array(levels, float)) == pytest.approx(0.02 * expected)


def test_what_is_not_counted_has_no_count():
    assert quantum(np.random.default_rng(0).standard_normal(500)) == 0.0


COIL = {"columns": {"flux_density": {"name": "v_V", "emf_turns": 100, "emf_area": 1e-5}}, "output": "flux_density"}


def emf_file(folder, emf, **columns):
    t = np.arange(len(emf)) / 20000
    table = {**columns, "time_s": t, "current_A": 0.5 * np.sin(2 * np.pi * 50 * t), "v_V": emf}
    path = folder / "emf.csv"
    np.savetxt(path, np.stack(list(table.values()), 1), delimiter=",", header=",".join(table), comments="", fmt="%.12g")
    return path


@pytest.mark.parametrize("merge", [False, True])
def test_a_clipped_emf_is_seen_before_it_is_integrated(tmp_path, merge):
    bench = dataclasses.replace(load_bench("aa-050h"), **COIL)
    t = np.arange(1600) / 20000
    emf = 0.1 * np.cos(2 * np.pi * 50 * t) + 0.03 * np.cos(2 * np.pi * 150 * t + 1)
    more = {}
    if merge:
        more = {"capture": np.repeat([0.0, 1.0], 800)}
        bench = dataclasses.replace(bench, columns={**bench.columns, "time": {"split": "capture", "merge": True}})
    (recording,) = load_recordings([emf_file(tmp_path, emf, **more)], bench)
    assert np.ptp(recording.channels["flux_density"]) > 0.1
    with pytest.raises(RecordingError, match=r"emf of flux_density is clipped at its highest value 80 mV for") as error:
        load_recordings([emf_file(tmp_path, np.minimum(emf, 0.08), **more)], bench)
    assert "\n" not in str(error.value) and ("capture=0" in str(error.value)) == merge


def test_a_cut_crest_is_seen_before_a_gap_in_it_is_filled(tmp_path):
    t = np.arange(1600) / 20000
    x = np.sin(2 * np.pi * 50 * t)
    rows = np.stack([t, 0.5 * x, np.minimum(1e-5 * x, 6e-6)], 1)
    keep = np.ones(len(t), bool)
    keep[[100, 101, 102, 500, 501, 502, 900, 901, 902]] = False  # in the plateaus, where harmonics would bulge
    np.savetxt(tmp_path / "r.csv", rows[keep], delimiter=",", header="time_s,current_A,displacement_m", comments="", fmt="%.12g")
    with pytest.raises(RecordingError, match="displacement is clipped at its highest value 6 um for"):
        load_recordings([tmp_path / "r.csv"], "aa-050h")


@pytest.mark.parametrize(
    ("runs", "after", "used"),
    [(((1.0, 0.7), (0.7, 0.5), (1.3, np.inf)), True, 3), (((1.0, 0.7), (1.3, 0.7), (0.5, np.inf)), True, 1), (((1.0, 0.7), (0.7, 0.5), (1.3, np.inf)), False, 1)],
    ids=["holds", "a limit", "cut with its noise"],
)  # fmt: skip
def test_a_level_that_other_recordings_pass_is_no_limit(tmp_path, runs, after, used):
    """Behind a play in the sensor the turning points of some records are flat with corners, each at its own level: they were refused as
    clipped. A limit is one for all, and a converter's cuts the noise, too. `runs`: (amplitude, where its crest is flat) of each."""
    rng, t = np.random.default_rng(3), np.arange(1600) / 20000
    drive, paths = np.sin(2 * np.pi * 50 * t), []
    for k, (amplitude, level) in enumerate(runs):
        noise = 3e-3 * rng.standard_normal(len(t))
        x = np.minimum(amplitude * drive, level) + noise if after else np.minimum(amplitude * drive + noise, level)
        paths.append(tmp_path / f"{k}.csv")
        rows = np.stack([t, amplitude * drive, 1e-5 * x], 1)
        np.savetxt(paths[-1], rows, delimiter=",", header="time_s,current_A,displacement_m", comments="", fmt="%.12g")
    sound, errors = load_sound(paths, load_bench("aa-050h"))
    assert [r.name for r in sound] == ["0.csv", "1.csv", "2.csv"][-used:]
    assert len(errors) == 3 - used and all("clipped" in str(error) for error in errors)


@pytest.mark.parametrize(("lowest", "current", "used"), [(-0.6, 1.0, True), (-0.6, 0.5, False)], ids=["both sides", "the current too"])
def test_a_hold_does_not_hide_what_else_is_cut(tmp_path, lowest, current, used):
    """A second plateau is asked about by itself, and a drive that is cut beside it is still refused."""
    rng, t = np.random.default_rng(3), np.arange(1600) / 20000
    drive, paths = np.sin(2 * np.pi * 50 * t), []
    for k, (amplitude, ends) in enumerate(((1.0, (lowest, 0.7)), (1.3, (-np.inf, np.inf)))):
        x = np.clip(amplitude * drive, *ends) + 3e-3 * rng.standard_normal(len(t))
        cut = np.minimum(amplitude * drive, current) if k == 0 else amplitude * drive
        paths.append(tmp_path / f"{k}.csv")
        np.savetxt(paths[-1], np.stack([t, cut, 1e-5 * x], 1), delimiter=",", header="time_s,current_A,displacement_m", comments="", fmt="%.12g")
    sound, errors = load_sound(paths, load_bench("aa-050h"))
    assert [r.name for r in sound] == (["0.csv", "1.csv"] if used else ["1.csv"])
    assert used or "current is clipped" in str(errors[0])


def test_measured_channels_are_not_clipped(measured):
    for path in sorted((measured / "rod_eddy").glob("captures_*.csv")):
        table, _ = read_csv(path)
        for capture in np.unique(table["capture"]):
            for column in ("v_shunt_V", "v_pickup_V"):
                assert not is_clipped(table[column][table["capture"] == capture]), (path.name, capture, column)


@pytest.mark.parametrize("number, clipped", [(33, True), (16, False), pytest.param(2, False, marks=pytest.mark.long)])  # a fault; fringe errors; an amplifier's limit
def test_benches_of_the_independent_generator(number, clipped):
    from tests.blind.cases import make_case, recordings_of

    case = make_case("dev", number)
    assert clipped == (case.instruments.get("fault") == "clipped")
    for name, _, current, displacement in recordings_of(case):
        assert is_clipped(displacement) == clipped, name
        assert not is_clipped(current), name
