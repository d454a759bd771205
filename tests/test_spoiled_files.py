"""Files as users have them: each is read as it is meant, or refused in one line that says what to mend."""

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import magjax
from fitting.floors import swapped
from fitting.outcome import outcome
from fitting.setup import spectra_of
from magjax.bench import load_bench
from magjax.cli import main
from magjax.cli.runtime import as_json
from magjax.errors import ConfigurationError, RecordingError
from magjax.inspection import inspect
from magjax.model_file import load_model
from magjax.readers import load_recordings
from magjax.recording import follows_nothing
from magjax.writers import write_recording

N, PERIODS, F = 200, 4, 50.0
PHASE = 2 * np.pi * np.arange(N * PERIODS) / N
TIME = np.arange(N * PERIODS) / (N * F)
CURRENT = 0.8 * np.sin(PHASE)
NOISE = np.random.default_rng(3).standard_normal(N * PERIODS)
READING = 3e-5 + 1e-5 * np.sin(PHASE - 0.6) + 3e-8 * NOISE


def rows(separator=",", comma=".", head="time_s,current_A,displacement_m", columns=(TIME, CURRENT, READING)):
    lines = [separator.join(f"{v:.9g}".replace(".", comma) for v in row) for row in zip(*columns, strict=True)]
    return "\n".join([head.replace(",", separator), *lines]) + "\n"


def read(tmp_path, text, name="rec.csv", bench="aa-050h"):
    path = tmp_path / name
    path.write_bytes(text.encode("utf-8") if isinstance(text, str) else text)
    return load_recordings([path], bench)[0]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read(tmp_path, separator):
    found = read(tmp_path, rows(separator, ","))
    assert np.abs(found.channels["displacement"] - READING).max() < 1e-13 and found.frequency() == pytest.approx(F)


@pytest.mark.parametrize(("text", "why"), [
    (rows(head="time_s,current_A,displacement_m\ns,A,m"), 'line 2 holds "s", which is no number'),
    (rows().replace("\n", "\n# so\n", 1).replace("0.005,", "0+1j,"), "which is no number"),
    (rows(head="time_s,current_A,current_A"), "two columns are named current_A"),
    (rows(head="time_s,current_A,displacement_m,displacement_um", columns=(TIME, CURRENT, READING, 1e6 * READING)), "both hold the displacement"),
    (rows(columns=(np.where(np.arange(len(TIME)) == 7, np.nan, TIME), CURRENT, READING)), "the time of sample 7 is no number"),
    (rows(columns=(TIME[: 2 * N], CURRENT[: 2 * N], np.where(np.arange(2 * N) == 9, 1e3, READING[: 2 * N]))), "only sample 9 does: a spike"),
    (rows().encode("utf-16"), "no text in UTF-8"),
    (rows(head="t,i,displacement_m"), "no columns for time, current among t, i, displacement_m; name them time_s, current_A or map them"),
    (rows(head="t,current_A,displacement_m"), "no time column among t, current_A, displacement_m"),
])  # fmt: skip
def test_what_cannot_be_meant_is_refused(tmp_path, text, why):
    with pytest.raises(RecordingError, match=why) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_unit_without_a_name_holds_for_the_column_that_is_found(tmp_path):
    bench = tmp_path / "b.toml"
    bench.write_text(
        Path(magjax.__file__).with_name("benches").joinpath("aa-050h.toml").read_text() + '\n[columns.displacement]\nunit = "um"\n'
    )
    found = read(tmp_path, rows(columns=(TIME, CURRENT, 1e6 * READING)), bench=bench)
    assert np.abs(found.channels["displacement"] - READING).max() < 1e-13


@pytest.mark.parametrize("how", ["instants", "spans", "words", "classic"])
def test_netcdf_as_others_write_it(tmp_path, how):
    import xarray as xr

    time = {"instants": np.datetime64("2026-01-02T03:04:05", "ns") + (TIME * 1e9).astype("timedelta64[ns]"),
            "spans": (TIME * 1e9).astype("timedelta64[ns]")}.get(how, TIME)  # fmt: skip
    data = xr.Dataset({"current": ("time", CURRENT, {"units": "ampere"}), "displacement": ("time", 1e6 * READING, {"units": "\u00b5m"}),
                       "operator": "A. B.", "temperature": 21.0}, {"time": time})  # fmt: skip
    if how == "classic":
        data = data.drop_vars("operator")
    data.to_netcdf(
        tmp_path / "r.nc",
        engine="scipy" if how == "classic" else "h5netcdf",
        format="NETCDF3_CLASSIC" if how == "classic" else None,
    )
    found = load_recordings([tmp_path / "r.nc"], "aa-050h")[0]
    assert found.frequency() == pytest.approx(F, rel=1e-6) and np.abs(found.channels["displacement"] - READING).max() < 1e-12


def test_matlab_files_with_more_in_them(tmp_path):
    from scipy.io import savemat

    good = {"time_s": TIME, "current_A": CURRENT, "displacement_m": READING}
    savemat(tmp_path / "more.mat", {"gains": np.arange(3.0), **good, "who": "A. B.", "run": {"x": 1}})
    assert load_recordings([tmp_path / "more.mat"], "aa-050h")[0].n_samples == len(TIME)
    savemat(tmp_path / "short.mat", {**good, "current_A": CURRENT[:-3]})
    savemat(tmp_path / "struct.mat", {"data": good})
    for name, why in (("short", "unequal length"), ("struct", "no vector of numbers")):
        with pytest.raises(RecordingError, match=why):
            load_recordings([tmp_path / f"{name}.mat"], "aa-050h")


def test_a_reading_that_follows_nothing_is_refused(tmp_path):
    bench = load_bench("aa-050h")
    good, lost = (read(tmp_path, rows(columns=(TIME, CURRENT, y))) for y in (READING, 3e-5 + 1e-5 * NOISE))
    weak = read(tmp_path, rows(columns=(TIME, CURRENT, 3e-5 + 1e-6 * (np.sin(PHASE) + NOISE))))  # buried, but there
    assert follows_nothing(lost, "displacement") and not any(follows_nothing(r, "displacement") for r in (good, weak))
    assert "does not follow the current" in inspect(lost, bench).problems[0] and not inspect(good, bench).problems
    with pytest.raises(RecordingError, match="does not follow the current"):
        spectra_of([good, lost], bench)


@pytest.mark.parametrize(
    ("own", "twice", "faster", "found"), [(-10e-6, 4e-6, -1, True), (-1e-6, 10e-6, 1, False), (-10e-6, 4e-6, 1, False), (-1e-6, 10e-6, -1, True)],
    ids=["all", "about no M", "M of the other sign", "the next tells"],
)  # fmt: skip
def test_a_reading_against_its_drive_is_swapped_where_its_sign_can_be_told(tmp_path, own, twice, faster, found):
    """A rod with friction whose M swung about zero read 0.6 um against its slowest drive, and 14 um at twice its frequency."""
    bench, runs = load_bench("aa-050h"), []
    for f, y in ((20, own * np.sin(PHASE - 0.2) + twice * np.sin(2 * PHASE)), (40, faster * 1e-5 * np.sin(PHASE - 0.4))):
        runs.append(read(tmp_path, rows(columns=(TIME * F / f, CURRENT, 3e-5 + y + 3e-8 * NOISE)), f"r{f}.csv"))
    assert (swapped(spectra_of(runs, bench)) is not None) is found


def test_a_sign_that_is_swapped_in_one_recording_is_found(tmp_path):
    bench, runs = load_bench("aa-050h"), []
    for f, lag, sign in ((20, 0.2, 1), (100, 1.0, -1), (300, 2.2, 1)):
        y = 3e-5 + 1e-5 * np.sin(PHASE - lag) + 3e-8 * NOISE
        runs.append(read(tmp_path, rows(columns=(TIME * F / f, sign * CURRENT, y)), f"r{f}.csv"))
    spectra = spectra_of(runs, bench)
    missed, met = ([SimpleNamespace(residual_rms=rms)] * 3 for rms in (7e-6, 2e-6))  # of 7e-6 rms about the mean
    assert "r100.csv moves against" in swapped(spectra, missed) and swapped(spectra) is None and swapped(spectra, met) is None
    assert swapped([spectra[0], spectra[2]], missed[:2]) is None and "at the lowest frequency" in swapped([s for s in spectra_of([
        read(tmp_path, rows(columns=(TIME, -CURRENT, READING)))], bench)])  # fmt: skip


def test_a_header_that_contradicts_by_a_thousand_tells_the_unit_of_the_time(tmp_path):
    card = inspect(read(tmp_path, f"# frequency_Hz: {F}\n" + rows(columns=(1e3 * TIME, CURRENT, READING))), load_bench("aa-050h"))
    assert any("name the column time_ms" in w for w in card.warnings)
    for odd in ("# frequency_Hz: inf\n", "# bridged_samples: nan\n"):
        assert not inspect(read(tmp_path, odd + rows()), load_bench("aa-050h")).problems
    jittered = TIME + 0.1 / (N * F) * NOISE.clip(-1, 1)
    assert any(
        "jitters" in w for w in inspect(read(tmp_path, rows(columns=(jittered, CURRENT, READING))), load_bench("aa-050h")).warnings
    )


def test_a_model_from_before_a_law_had_a_detail_is_read(tmp_path):
    from fitting.result import write_model
    from magjax.effects import StressFeedback

    bench = load_bench("aa-050h")
    write_model(tmp_path, bench.actuator().with_effect(StressFeedback(stiffness=1e10, inertia=3.0)), bench)
    content = json.loads((tmp_path / "model.json").read_text())
    assert content["parameters"].pop("effects.stress_feedback.inertia") == 3.0
    (tmp_path / "model.json").write_text(json.dumps(content))
    effect = load_model(tmp_path)[0].effect("stress_feedback")
    assert float(effect.stiffness) == 1e10 and float(effect.inertia) == 0.0


@pytest.mark.parametrize(("change", "why"), [
    (lambda m: m["parameters"].update({"coil.R_eddy": float("nan")}), "coil.R_eddy is not a finite number"),
    (lambda m: m["parameters"].update({"coil.R_eddy": -5.0}), "coil.R_eddy = -5 is outside"),
    (lambda m: m["parameters"].pop("mechanics.f0"), "lacks mechanics.f0"),
    (lambda m: m["parameters"].update({"effects.sensor_nonlinearity.q2": 0.1}), "q2, which no block and no effect has: of another version"),
])  # fmt: skip
def test_a_model_that_was_spoiled_is_refused(tmp_path, change, why):
    from fitting.result import write_model

    bench = load_bench("aa-050h")
    write_model(tmp_path, bench.actuator(), bench)
    load_model(tmp_path)
    content = json.loads((tmp_path / "model.json").read_text())
    change(content)
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(ConfigurationError, match=why):
        load_model(tmp_path)


def test_an_output_never_replaces_what_is_read(tmp_path):
    path, binary = tmp_path / "rec.csv", tmp_path / "rec.nc"
    path.write_text(rows())
    write_recording(binary, load_recordings([path], "aa-050h")[0])
    before = binary.read_bytes()

    def refused(*command):
        ended = subprocess.run([sys.executable, "-m", "magjax", *map(str, command)], capture_output=True, text=True)
        return ended.stderr if ended.returncode == 2 else ""

    assert "is the file that is read" in refused("export", path, "--out", path)
    assert "is the file that is read" in refused("invert", path, "--out", path)
    assert "is the file that is read" in refused("simulate", "--drive", binary, "--out", binary)
    assert f"name it {binary}" in refused("simulate", "--drive", binary, "--out", path)
    assert path.read_text() == rows() and binary.read_bytes() == before


@pytest.mark.parametrize(("name", "content", "why"), [
    ("fit.json", "{}", "is no result"), ("fit.json", "[]", "is no result"), ("diagnosis.json", '{"verdict": "group"}', "no base"),
    ("fit.json", '{"chi2_per_sample": 1.0}', "report.npz cannot be read"),
])  # fmt: skip
def test_a_result_folder_that_was_spoiled_is_told(tmp_path, name, content, why):
    from fitting.report import rebuild

    (tmp_path / name).write_text(content)
    (tmp_path / "report.npz").write_bytes(b"PK\3\4 cut")
    with pytest.raises(ConfigurationError, match=why):
        rebuild(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_what_stands_where_the_report_goes_is_told(tmp_path):
    from fitting.report.page import render

    (tmp_path / "report.html").mkdir()
    with pytest.raises(ConfigurationError, match="move it away"):
        render(tmp_path / "report.html", {"title": "t", "sections": []}, "")


def test_a_fit_that_has_led_nowhere_says_so():
    rows = [SimpleNamespace(chi2_per_sample=c, file=f"runs/r{c}.csv", frequency=50.0) for c in (3.0, 4e5)]
    solution = SimpleNamespace(interrupted=False, converged=True, jacobians=9)
    for chi2n in (2e5, np.nan):
        told = outcome(chi2n, rows, solution, (), SimpleNamespace(spectra=()))
        assert told.startswith("the fit has led nowhere") and "r400000.0.csv" in told and "\n" not in told
    at = (SimpleNamespace(name="mechanics.xi", at_bound=True),)
    assert "20 times its noise (worst: r400000.0.csv)" in outcome(400.0, rows, solution, at, SimpleNamespace(spectra=()))


def test_numbers_that_are_none_are_null_in_json():
    found = as_json({"a": [np.nan, 1.5, {"b": -np.inf}], "c": (float("nan"),), "d": True, "e": None})
    assert json.loads(found) == {"a": [None, 1.5, {"b": None}], "c": [None], "d": True, "e": None} and "NaN" not in found


@pytest.mark.parametrize(("options", "why"), [
    (["--cells", "100000"], "takes 120"), (["--max-jacobians", "0"], "max-jacobians"), (["--model", ""], "not a fitted model"),
    (["--profile", "f0,colour"], '"colour" is not free in this fit; free are coil.R_eddy'),
])  # fmt: skip
def test_options_that_cannot_work_are_refused_first(tmp_path, options, why, capsys, monkeypatch):
    monkeypatch.setattr(importlib.import_module("fitting.fit"), "fit", lambda *_, **__: pytest.fail("the fit has begun"))
    path = tmp_path / "rec.csv"
    path.write_text(rows())
    bench = [] if "--model" in options else ["--bench", "aa-050h"]
    try:
        status = main(["fit", str(path), *bench, *options])
    except SystemExit as ended:
        status = ended.code
    said = capsys.readouterr().err
    assert status == 2 and why in said and len(said.strip().splitlines()) == 1


def test_a_drive_that_is_hardly_felt_is_warned_of(tmp_path):
    card = inspect(read(tmp_path, rows(columns=(TIME, 1e-3 * CURRENT, READING))), load_bench("aa-050h"))
    assert any("unit and scale" in w for w in card.warnings) and not card.problems


@pytest.mark.parametrize(
    ("column", "value", "why"), [("displacement_m", np.inf, "infinite at sample 5"), ("time_s", 0.0, "does not increase")]
)
def test_what_no_number_can_be_is_one_line(tmp_path, column, value, why):
    """A single infinite sample, and times that are the same but for a jump."""
    columns = {"time_s": TIME.copy(), "current_A": CURRENT, "displacement_m": 3e-5 + 1e-5 * CURRENT + 1e-8 * NOISE}
    columns[column][slice(5, 6) if column != "time_s" else slice(0, -1)] = value
    np.savetxt(tmp_path / "a.csv", np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments="")
    with pytest.raises(RecordingError, match=why):
        load_recordings([tmp_path / "a.csv"], load_bench("aa-050h"))


def test_json_holds_no_numbers_that_are_none():
    assert json.loads(as_json({"a": [1.0, float("nan")], "b": {"c": float("inf")}})) == {"a": [1.0, None], "b": {"c": None}}


def test_a_fit_that_broke_down_leaves_no_model(tmp_path):
    from fitting.result import write_model

    bench = load_bench("aa-050h")
    actuator = bench.actuator()
    write_model(tmp_path, actuator, bench)
    assert (tmp_path / "model.json").exists()
    write_model(tmp_path, actuator.replace({"coil.R_eddy": float("nan")}), bench)
    assert not (tmp_path / "model.json").exists()


def test_points_and_labels_that_are_no_numbers_are_told_with_their_file(tmp_path):
    label = np.repeat([1.0, 2.0], len(TIME) // 2)
    label[7] = np.nan
    table = rows(head="loop,current_A,flux_density_T", columns=(label, CURRENT, READING))
    own = tmp_path / "loops.toml"
    own.write_text('name = "loops"\n[columns.time]\nquasistatic = true\nsplit = "loop"\n')
    with pytest.raises(RecordingError, match=r"loops.csv: loop, at which the file is split, is no number in row 7"):
        read(tmp_path, table, "loops.csv", own)
    own.write_text('name = "loops"\n[columns.time]\nquasistatic = true\n')
    broken = CURRENT.copy()
    broken[3] = np.nan
    for drive, why in ((broken, "not a number at point 3"), (np.zeros_like(CURRENT), "current never changes")):
        table = rows(head="current_A,flux_density_T", columns=(drive, READING))
        with pytest.raises(RecordingError, match=f"loops.csv.*{why}"):
            read(tmp_path, table, "loops.csv", own)


@pytest.mark.parametrize(("empty", "filled"), [([7], True), (range(300, 340), True), (range(300, 400), False)])
def test_empty_cells_of_a_periodic_run_are_filled_from_its_harmonics(tmp_path, empty, filled):
    """The mend that a spike or an infinite sample is given."""
    reading = READING.copy()
    reading[list(empty)] = np.nan
    text = rows(columns=(TIME, CURRENT, reading)).replace("nan", "")
    if not filled:
        with pytest.raises(RecordingError, match="not a number at sample 300"):
            read(tmp_path, text)
        return
    found = read(tmp_path, text)
    assert len(found.time) == len(TIME) and found.origin["metadata"]["bridged_samples"] == len(empty)
    assert np.abs(found.channels["displacement"] - READING).max() < 2e-7
