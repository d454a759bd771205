"""Commands as a user runs them: files, exit statuses, one-line errors with the mend, nothing half written."""

import dataclasses
import importlib
import json

import jax
import numpy as np
import pytest

import fitting.paper
from fitting.demo import concealed_actuator, record
from fitting.diagnosis import Diagnosis
from fitting.fit import fit
from magjax.bench import load_bench
from magjax.cli import COMMANDS, main
from magjax.model_file import load_model
from magjax.recording import load_recordings
from magjax.writers import write_recording

DIAGNOSE, FIT = (importlib.import_module(f"fitting.{name}") for name in ("diagnose", "fit"))  # the modules


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench")
    rng = np.random.default_rng(1)
    truth = concealed_actuator(load_bench("aa-050h"))
    for drive in ((10, 0.8, 0.1), (80, 0.5, -0.2), (250, 0.8, 0.1)):
        write_recording(path / f"rec_{drive[0]:03d}.csv", record(truth, *drive, rng, "r"))
    return path


def test_options_that_take_files_may_be_given_again():
    from magjax.cli.fit import _common

    options = _common("fit", "text", "example").parse_args(["a.csv", "--check", "b.csv", "c.csv", "--check", "d.csv"])
    assert options.check == ["b.csv", "c.csv", "d.csv"]


def test_fit_writes_what_the_interface_promises(folder, capsys, monkeypatch):
    out = folder / "result"
    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    returned = []
    monkeypatch.setattr(FIT, "fit", lambda *a, **k: returned.append(fit(*a, **k)) or returned[-1])
    assert main(["fit", *files, "--bench", "aa-050h", "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    content = json.loads((out / "fit.json").read_text())
    for key in (
        "converged",
        "message",
        "bench",
        "recordings",
        "parameters",
        "levels",
        "chi2_per_sample",
        "bic",
        "jacobians",
        "compile_s",
        "solve_s",
    ):
        assert key in content and key in printed
    assert set(content["parameters"]["coil.R_eddy"]) >= {"value", "stderr", "unit", "free", "at_bound", "identified"}
    assert content["recordings"][0]["sha256"] and content["chi2_per_sample"] < 1.25
    page = (out / "report.html").read_text()
    assert page.count("<svg") >= 3 and "http://" not in page.replace("http://www.w3.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")
    assert len(page) < 1_500_000 and 'aria-label="' in page
    # model.json is the actuator that the fit returned, bit for bit
    actuator, bench = load_model(out)
    (fitted,) = returned
    (now, shape), (then, expected) = jax.tree.flatten(actuator), jax.tree.flatten(fitted.actuator)
    assert shape == expected and all(np.array_equal(a, b) for a, b in zip(now, then, strict=True))
    assert dataclasses.replace(bench, source="") == dataclasses.replace(fitted.bench, source="")
    assert (
        main(["simulate", "--model", str(out), "--frequency", "50", "--amplitude", "0.5", "--out", str(folder / "s.nc"), "--quiet"])
        == 0
    )
    assert main(["report", str(out)]) == 0


def test_an_interrupted_fit_keeps_what_it_reached(folder, capsys, monkeypatch):
    solve = FIT.solve

    def interrupted(*arguments, progress=None, **options):
        def stop(step, chi2):
            raise KeyboardInterrupt

        return solve(*arguments, progress=stop, **options)

    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    monkeypatch.setattr(FIT, "solve", interrupted)
    assert main(["fit", *files, "--bench", "aa-050h", "--out", str(folder / "stopped")]) == 130
    said = capsys.readouterr().out
    assert "interrupted after 1 Jacobians" in said and "raise" not in said
    assert load_model(folder / "stopped")[1].name == "aa-050h"


def test_a_refused_fit_leaves_no_empty_folder(folder, capsys, monkeypatch):
    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    out = folder / "refused"
    assert main(["fit", *files, str(folder / "none.csv"), "--bench", "aa-050h", "--out", str(out)]) in (2, 3)
    assert not out.exists()
    monkeypatch.setattr(FIT, "build_problem", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    assert main(["fit", *files, "--bench", "aa-050h", "--out", str(out)]) == 130 and not out.exists()
    with pytest.raises(SystemExit):
        main(["fit", *files, "--bench", "aa-050h", "--cells", "-3"])
    assert "at least 2 cells" in capsys.readouterr().err


def test_sweep_and_convert(folder, capsys):
    assert main(["sweep", "--frequencies", "10,100", "--amplitudes", "0.3,0.6", "--out", str(folder / "sweep.nc"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 4
    source = sorted(folder.glob("rec_*.csv"))[0]
    bench = load_bench("aa-050h")
    original = load_recordings([source], bench)[0]
    for ending in (".nc", ".mat", ".csv"):
        target = folder / f"copy{ending}"
        assert main(["export", str(source), "--out", str(target), "--quiet"]) == 0
        back = load_recordings([target], bench)[0]
        assert back.channels["displacement"] == pytest.approx(original.channels["displacement"], rel=1e-9)


def test_check_card(folder, capsys):
    source = sorted(folder.glob("rec_*.csv"))[0]
    assert main(["check", str(source)]) == 0
    text = capsys.readouterr().out
    assert "fit to use" in text and "10 Hz" in text and "4.000 periods" in text


def write(path, rows, header="time_s,current_A,displacement_m"):
    path.write_text(header + "\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows) + "\n")
    return str(path)


def good_rows(n=400, periods=4):
    t = np.arange(n * periods) / (50 * n)
    current = 0.5 * np.sin(2 * np.pi * 50 * t)
    noise = 1e-8 * np.random.default_rng(0).standard_normal(len(t))
    return np.stack([t, current, 2e-5 + 1e-5 * current + noise], axis=1)


def spoil(kind):
    rows, header = good_rows(), "time_s,current_A,displacement_m"
    if kind == "missing column":
        return rows[:, :2], "time_s,current_A"
    if kind == "mA for A":
        rows[:, 1] *= 1000
    if kind == "um for m":
        rows[:, 2] *= 1e6
    if kind == "NaN":
        rows[100:300, 2] = np.nan
    if kind == "gap":
        rows[300:, 0] += 0.013
    if kind == "clipped":
        rows[:, 2] = np.clip(rows[:, 2], None, 2.25e-5)
    if kind == "no samples":
        rows = rows[:0]
    return rows, header


@pytest.mark.parametrize(
    ("kind", "words"),
    [("missing column", "displacement_m"), ("mA for A", "current_mA"), ("um for m", "displacement_um"), ("NaN", "sample 100"),
     ("gap", "not uniform"), ("clipped", "clipped"), ("no samples", "no samples")],
)  # fmt: skip
def test_bad_recordings_say_the_mend_in_one_line(tmp_path, capsys, kind, words):
    rows, header = spoil(kind)
    path = write(tmp_path / "bad.csv", rows, header)
    out = tmp_path / "out"
    assert main(["fit", path, "--bench", "aa-050h", "--out", str(out), "--quiet"]) == 3
    error = capsys.readouterr().err.strip()
    assert words in error and "bad.csv" in error and "\n" not in error
    assert not (out / "fit.json").exists()


def test_a_check_recording_that_cannot_be_used_ends_nothing(tmp_path, capsys, monkeypatch):
    """It takes part in no fit: it is left out and told. One that is not there is a slip of the pen."""
    held = []
    monkeypatch.setattr(
        DIAGNOSE, "diagnose", lambda *a, check, **k: held.append(len(check)) or Diagnosis("nothing_missing", "All is well.")
    )
    good, bad = write(tmp_path / "good.csv", good_rows()), write(tmp_path / "bad.csv", *spoil("clipped"))
    other = write(tmp_path / "other.csv", good_rows()[:-1])
    command = ["diagnose", good, "--bench", "aa-050h", "--quiet", "--check"]
    assert main([*command, other, bad, "--out", str(tmp_path / "out")]) == 0
    said, kept = capsys.readouterr().out, json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert held == [1] and "bad.csv" in said and "clipped" in said and "Left out of the checks" in said
    assert kept["verdict"] == "nothing_missing" and "bad.csv" in kept["check_left_out"][0] and kept["message"] in said
    assert main([*command, str(tmp_path / "none.csv")]) == 3
    assert "no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[coil]\nR_edy = 3\n", "R_eddy"),
        ("[coil]\nR_eddy = -3\n", "negative"),
        ("[coil\n", "TOML"),
        ("[hysteresis]\nlevels = 'x'\n", "levels"),
        ("[fit]\nfree = ['coil.Reddy']\n", "R_eddy"),
        (b"# R\xe9sistance\n", "UTF-8"),
    ],
)
def test_bad_bench_files_say_the_mend(tmp_path, capsys, text, words):
    (tmp_path / "bench.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    path = write(tmp_path / "rec.csv", good_rows())
    assert main(["fit", path, "--bench", str(tmp_path / "bench.toml"), "--quiet"]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error and "\n" not in error


def test_wrong_use(tmp_path, capsys):
    assert main(["ft"]) == 2 and "fit" in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "none.csv"), "--bench", "aa-050h", "--quiet"]) == 3
    assert "no such file" in capsys.readouterr().err
    (tmp_path / "empty.csv").write_text("")
    assert main(["check", str(tmp_path / "empty.csv")]) == 3
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert main(["sweep", "--out", str(blocked / "x" / "y.nc"), "--quiet"]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "rec.csv"), "--bench", "aa-050h", "--out", str(blocked / "below"), "--quiet"]) == 2
    error = capsys.readouterr().err.strip()
    assert f"{blocked / 'below'}: cannot be written" in error and "--out" in error and "\n" not in error
    assert main(["simulate", "--amplitude", "9", "--out", str(tmp_path / "s.nc"), "--quiet"]) == 2
    assert "outside the Preisach plane" in capsys.readouterr().err
    assert main(["diagnose", "rec.csv", "--bench", "aa-050h", "--only", "villari"]) == 2
    assert 'no effect "villari"; the catalogue has amplifier_lag' in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    try:
        assert main([command, "--help"]) == 0
    except SystemExit as stop:
        assert stop.code == 0
    assert "example: magjax" in capsys.readouterr().out


def test_the_papers_loops_and_recipe(tmp_path, capsys, monkeypatch):
    """`demo --paper` on fewer frequencies and a coarser mesh: its page, its pictures and its numbers say the same."""
    monkeypatch.setattr(fitting.paper, "FREQUENCIES", (20, 100, 200))
    monkeypatch.setattr(fitting.paper, "MESH", np.array([50.0, 70.0, 90.0]))
    assert main(["demo", "--paper", "--out", str(tmp_path), "--quiet"]) == 0
    assert "R_eddy = 70 ohm" in capsys.readouterr().out
    recipe = json.loads((tmp_path / "paper.json").read_text())["recipe"]
    assert recipe["R_eddy"] == 70 and recipe["damping_ratio"] == pytest.approx(0.7783, abs=3e-3)
    assert recipe["frequencies"] == pytest.approx([20, 100, 200]) and np.shape(recipe["xi"]) == (3, 3)
    page = (tmp_path / "paper.html").read_text()
    for R, row in zip(recipe["resistances"], recipe["xi"], strict=True):
        cells = f">{R:g}</th>" + "".join(f'<td class="n">{x:.4f}</td>' for x in row)
        assert cells in "".join(line.strip() for line in page.splitlines())
    for name, curves, words in (
        ("paper_loops", 6, ("[-0.7, 0.9] A", "[-0.7, 0.3] A", "20 Hz", "200 Hz", "displacement")),
        ("lag_table", 3, ("50 ohm", "70 ohm", "damping ratio")),
    ):
        drawn = (tmp_path / "figures" / f"{name}.svg").read_text()
        assert drawn.count("clip-path=") >= curves and all(f">{word}" in drawn for word in words), name
    assert page.count("<svg") == 2


def test_an_interrupted_diagnosis_keeps_the_plain_fit(folder, capsys, monkeypatch):
    def stopped(*arguments):
        raise KeyboardInterrupt

    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    out = folder / "half"
    monkeypatch.setattr(DIAGNOSE, "screened", stopped)
    assert main(["diagnose", *files, "--bench", "aa-050h", "--out", str(out)]) == 130
    assert "the plain fit is kept in" in capsys.readouterr().err
    assert json.loads((out / "fit.json").read_text())["parameters"]["coil.R_eddy"]["free"]
    assert load_model(out)[1].name == "aa-050h" and (out / "report.html").exists() and not (out / "diagnosis.json").exists()
    monkeypatch.setattr(DIAGNOSE, "spectra_of", stopped)
    assert main(["diagnose", *files, "--bench", "aa-050h", "--out", str(folder / "before")]) == 130
    assert "nothing was reached" in capsys.readouterr().err and not (folder / "before").exists()


@pytest.mark.parametrize("command", ["fit", "diagnose"])
@pytest.mark.parametrize(
    ("again", "why"),
    [(["--check", "{0}"], "a check that is also fitted checks nothing"), (["{1}"], "is given twice; it would count twice"),
     (["{copy}"], "holds the same as"), (["{again}"], "holds the samples of"), (["--check", "{again}"], "a check that is also fitted"),
     (["--check", "{none}"], "no such file")],
    ids=["fitted and to check", "twice", "a copy", "saved again", "saved again to check", "not there"],
)  # fmt: skip
def test_files_that_are_not_there_or_given_twice_are_refused_first(folder, tmp_path, capsys, command, again, why):
    files = sorted(folder.glob("rec_*.csv"))
    copy, kept = tmp_path / "copy.csv", tmp_path / "out"
    copy.write_bytes(files[0].read_bytes())
    again_saved = tmp_path / "again.csv"
    again_saved.write_text(files[0].read_text() + "\n\n")
    kept.mkdir()
    (kept / "diagnosis.json").write_text("{}")  # of an earlier diagnosis
    more = [a.format(*files, copy=copy, again=again_saved, none=tmp_path / "none.csv") for a in again]
    assert main([command, *map(str, files), *more, "--bench", "aa-050h", "--out", str(kept)]) in (2, 3)
    said = capsys.readouterr().err
    assert why in said and len(said.strip().splitlines()) == 1
    assert [p.name for p in kept.iterdir()] == ["diagnosis.json"]


def test_what_cannot_be_written_is_one_line(folder, capsys, monkeypatch):
    (folder / "taken").mkdir(exist_ok=True)
    (folder / "taken" / "fit.json").mkdir(exist_ok=True)
    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    assert main(["fit", *files, "--bench", "aa-050h", "--out", str(folder / "taken"), "--quiet"]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "cannot be read or written" in said[0]
    assert not list((folder / "taken").glob("*.part"))
