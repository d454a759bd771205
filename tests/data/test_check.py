"""What `magjax check` says of recordings: one card a file, gaps, headers, units, limits, single periods."""

import dataclasses
import json

import numpy as np
import pytest

from magjax.bench import load_bench
from magjax.cli import main
from magjax.errors import RecordingError
from magjax.inspection import inspect, inspect_files
from magjax.readers import read_file
from magjax.recording import Recording, fundamental, load_recordings

BENCH = load_bench("aa-050h")


def table(periods=4, samples=400, amplitude=0.5, frequency=50.0):
    t = np.arange(int(samples * periods)) / (samples * frequency)
    current = amplitude * np.sin(2 * np.pi * frequency * t)
    noise = 1e-8 * np.random.default_rng(0).standard_normal(len(t))
    return {"time_s": t, "current_A": current, "displacement_m": 2e-5 + 2e-5 * current / amplitude + noise}


def written(path, columns, head=""):
    np.savetxt(path, np.stack(list(columns.values()), 1), delimiter=",", header=head + ",".join(columns), comments="", fmt="%.12g")
    return path


def card(path, columns, head="", bench=BENCH):
    (found,) = inspect_files([written(path, columns, head)], bench)
    return found


def test_every_file_has_its_card(tmp_path, capsys):
    good = written(tmp_path / "good.csv", table())
    nan = table()
    nan["displacement_m"][100 : 100 + len(nan["displacement_m"]) // 5] = np.nan  # more than are filled
    clip = table()
    clip["displacement_m"] = np.minimum(clip["displacement_m"], 3e-5)
    files = [str(written(tmp_path / f"{n}.csv", c)) for n, c in (("nan", nan), ("clip", clip))]
    files = [str(good), files[0], str(tmp_path / "absent.csv"), files[1], str(good)]
    assert main(["check", *files, "--json"]) == 3
    cards = json.loads(capsys.readouterr().out)
    assert [c["usable"] for c in cards] == [True, False, False, False, True]
    for c, words in zip(cards[1:4], ("sample 100", "no such file", "clipped"), strict=True):
        assert words in c["problems"][0] and "\n" not in c["problems"][0]
    assert main(["check", *files]) == 3
    text = capsys.readouterr().out
    assert text.count(": fit to use") == 2 and text.count("NOT fit to use") == 3
    assert main(["check", str(good)]) == 0


def test_a_filled_gap_is_told_and_a_large_one_is_a_problem(tmp_path):
    def without(lost):
        return {q: np.delete(v, lost) for q, v in table().items()}

    assert "gaps" not in card(tmp_path / "r.csv", table()).facts
    small = card(tmp_path / "r.csv", without(700 + np.arange(40)))
    assert small.facts["gaps"].startswith("40 samples missing") and not small.problems
    assert any("40 missing samples were filled" in w for w in small.as_dict()["warnings"])
    (often,) = card(tmp_path / "r.csv", without(5 + np.arange(0, 1590, 12))).problems
    assert "133 samples missing" in often and "widest gap is 1" in often
    (wide,) = card(tmp_path / "r.csv", without(700 + np.arange(110))).problems  # more than harmonics can bridge
    assert "not uniform" in wide and "sample 700" in wide


@pytest.mark.parametrize("stated, told", [(50, False), (50.2, False), (37, True), (25, True), (100, True), (5, True), (800, True)])
def test_the_signal_is_believed_over_its_header(tmp_path, stated, told):
    found = card(tmp_path / "r.csv", table(), f"# frequency_Hz: {stated}\n")
    assert found.facts["fundamental"].startswith("50 Hz, 4.000 periods")
    assert told == any(f"the header says {stated} Hz" in w and "50 Hz" in w for w in found.warnings)


def test_a_header_tells_the_whole_period_of_a_weak_modulation():
    t = np.arange(4000) / 1000
    x = np.sin(2 * np.pi * 10 * t) * (1 + 0.1 * np.cos(2 * np.pi * t))
    assert fundamental(x, 1e-3, 1.01) == pytest.approx(1, rel=1e-3)
    assert fundamental(np.sin(2 * np.pi * 10 * t), 1e-3, 1.01) == pytest.approx(10, rel=1e-5)


def test_a_header_that_is_no_number_is_left(tmp_path):
    assert card(tmp_path / "r.csv", table(), "# frequency_Hz: fifty\n").facts["fundamental"].startswith("50 Hz")


@pytest.mark.parametrize("start", [0.0, -0.05, 0.02])
@pytest.mark.parametrize("samples", [40, 400, 4000])
def test_half_a_period_is_no_period(start, samples):
    n = int(samples * (0.5 - 2 * start))
    t = start + np.arange(n + 1) / samples
    assert fundamental(np.sin(2 * np.pi * t), 1 / samples) is None
    assert fundamental(np.sin(2 * np.pi * t), 1 / samples, 1.0) is None


@pytest.mark.parametrize("shift", [0, 0.1, 0.25, 0.6])
@pytest.mark.parametrize("samples", [16, 40, 4000])
def test_one_period_is_one_wherever_it_begins(shift, samples):
    t = np.arange(samples) / samples + shift
    for x in (np.sin(2 * np.pi * t), np.arcsin(np.sin(2 * np.pi * t)), np.sin(2 * np.pi * t) + 0.5 * np.sin(6 * np.pi * t)):
        assert fundamental(x, 1 / samples) == pytest.approx(1)


def test_what_stands_still_beside_is_no_fault(tmp_path):
    columns = table() | {"temperature_degC": np.full(1600, 23.0), "voltage_V": np.zeros(1600)}
    assert not card(tmp_path / "r.csv", columns).problems
    for channel in ("current_A", "displacement_m"):
        (problem,) = card(tmp_path / "r.csv", columns | {channel: np.full(1600, 1e-5)}).problems
        assert f"{channel[:-2]} never changes" in problem


def test_kelvins_become_degrees(tmp_path):
    path = written(tmp_path / "r.csv", table() | {"temperature_K": np.linspace(296.0, 297.0, 1600)})
    (recording,) = load_recordings([path], BENCH)
    assert recording.channels["temperature"][[0, -1]] == pytest.approx([22.85, 23.85])
    mapped = dataclasses.replace(BENCH, columns={"temperature": {"name": "Pt100", "unit": "K", "scale": 0.1}})
    path = written(tmp_path / "s.csv", table() | {"Pt100": np.full(1600, 2960.0)})
    assert load_recordings([path], mapped)[0].channels["temperature"] == pytest.approx(22.85)


def test_a_drive_beyond_the_limit_is_a_warning(tmp_path):
    assert not card(tmp_path / "r.csv", table(amplitude=0.9)).warnings
    (warning,) = card(tmp_path / "r.csv", table(amplitude=2.0)).warnings
    assert "reaches 2 A" in warning and "limit is 0.9 A" in warning


def test_milliamperes_are_doubted_where_no_limit_is_stated(tmp_path):
    bench = dataclasses.replace(BENCH, limits={})
    assert not card(tmp_path / "r.csv", table(), bench=bench).warnings
    (warning,) = card(tmp_path / "r.csv", table(amplitude=50.0), bench=bench).warnings
    assert "current_mA" in warning and "A/m" in warning


@pytest.mark.parametrize("said", ["m", "mm", "um"])
@pytest.mark.parametrize("true", ["m", "mm", "um", "nm"])
def test_the_mend_names_the_unit_that_makes_sense(tmp_path, said, true):
    factor = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9}
    columns = table()
    columns = {
        "time_s": columns["time_s"],
        "current_A": columns["current_A"],
        f"displacement_{said}": columns["displacement_m"] * factor[true],
    }
    found = card(tmp_path / "r.csv", columns)
    if factor[true] / factor[said] in (1.0, 1e-3):  # a stroke of 40 nm is small, not absurd
        assert not found.problems
    else:
        assert f"name it displacement_{true} or" in found.problems[0]


def test_a_single_period_warns_that_its_noise_is_a_guess(tmp_path):
    for periods, guess in ((1, True), (1.7, True), (2, False), (4, False)):
        found = card(tmp_path / "r.csv", table(periods), "# frequency_Hz: 50\n")
        assert guess == any("guess the noise" in w and "three or more" in w for w in found.warnings), periods
        (recording,) = load_recordings([tmp_path / "r.csv"], BENCH)
        assert recording.noise_is_a_guess("displacement") == guess
    one = Recording(
        np.arange(400) / 2e4, {"current": table(1)["current_A"], "displacement": table(1)["displacement_m"]}, {"displacement": 1e-8}
    )
    assert not one.noise_is_a_guess("displacement") and not inspect(one, BENCH).warnings


@pytest.mark.parametrize("ending", [".parquet", ".xlsx", ".tdms"])
def test_an_unknown_ending_is_told(tmp_path, ending):
    path = written(tmp_path / f"r{ending}", table())
    with pytest.raises(RecordingError, match=r"\.csv, .*\.nc.*\.mjlog|\.nc, .*\.csv") as error:
        read_file(path, BENCH)
    assert ending in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["r.csv", "r.TXT", "r.dat", "r"])
def test_text_is_read_under_its_usual_endings(tmp_path, name):
    assert not inspect_files([written(tmp_path / name, table())], BENCH)[0].problems
