"""A fleet: one fit a folder, failures as rows, the table, resumed; and the options on the command line."""

import csv
import importlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fitting.demo import record
from fitting.scale import fit_fleet
from magjax.cli import main
from magjax.cli.pages.commands import parser_of
from magjax.errors import ConfigurationError
from magjax.model_file import load_model
from magjax.writers import write_recording
from tests.scale.conftest import SINES

ROOT = Path(__file__).resolve().parents[2]
RESISTANCES = (50.0, 62.0, 75.0)


@pytest.fixture(scope="module")
def folders(tmp_path_factory, truth):
    """Three good actuators, one with a clipped recording, one without any."""
    root = tmp_path_factory.mktemp("fleet")
    for k, resistance in enumerate(RESISTANCES):
        folder = root / f"rod{k}"
        folder.mkdir()
        rng = np.random.default_rng(k)
        for drive in SINES:
            write_recording(
                folder / f"rec_{drive[0]:03d}.csv", record(truth.replace({"coil.R_eddy": resistance}), *drive, rng, "r")
            )
        (folder / "check_aside.csv").write_text("never read")
    (root / "broken").mkdir()
    text = (root / "rod0" / "rec_010.csv").read_text().splitlines()
    text[200:900] = [row.split(",")[0] + ",nan,nan" for row in text[200:900]]
    (root / "broken" / "rec_010.csv").write_text("\n".join(text) + "\n")
    (root / "empty").mkdir()
    (root / "notes.txt").write_text("no folder")
    return root


@pytest.fixture(scope="module")
def fleet(folders, quick, tmp_path_factory):
    checkpoint = tmp_path_factory.mktemp("kept") / "fleet"
    return fit_fleet(sorted(folders.iterdir()), "aa-050h", choices=quick, checkpoint=checkpoint), checkpoint


@pytest.mark.long
def test_every_folder_is_a_row(fleet):
    found, _ = fleet
    assert [r["name"] for r in found.rows] == ["broken", "empty", "rod0", "rod1", "rod2"]
    assert (found.count("fitted"), found.count("failed")) == (3, 2)
    for row, resistance in zip(found.rows[2:], RESISTANCES, strict=True):
        assert row["recordings"] == 3 and row["parameters"]["coil.R_eddy"]["value"] == pytest.approx(resistance, rel=0.01)
    assert "sample" in found.rows[0]["message"] and "no recordings" in found.rows[1]["message"]
    assert "3 fitted, 0 not converged, 2 failed of 5" in str(found)


@pytest.mark.long
def test_the_table(fleet):
    found, _ = fleet
    lines = found.csv().splitlines()
    assert "# coil.R_eddy: ohm" in lines
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert float(rows[3]["coil.R_eddy"]) == found.rows[3]["parameters"]["coil.R_eddy"]["value"] and rows[0]["coil.R_eddy"] == ""
    data = found.dataset()
    assert data["mechanics.f0"].attrs["units"] == "Hz" and np.isnan(data["coil.R_eddy"].sel(actuator="empty").item())
    assert list(data.status.values) == ["failed", "failed", "fitted", "fitted", "fitted"]


@pytest.mark.long
def test_resumed_and_changed(fleet, folders, quick):
    found, checkpoint = fleet
    again = fit_fleet(sorted(folders.iterdir()), "aa-050h", choices=quick, checkpoint=checkpoint)
    assert again.outcome.resumed == 5 and again.rows == found.rows
    (folders / "empty" / "rec.csv").write_text("time_s,current_A\n")
    changed = fit_fleet(sorted(folders.iterdir()), "aa-050h", choices=quick, checkpoint=checkpoint)
    assert changed.outcome.resumed == 4 and changed.rows[1]["message"] != found.rows[1]["message"]
    (folders / "empty" / "rec.csv").unlink()


@pytest.mark.long
def test_a_folder_without_bench(folders, quick):
    row = fit_fleet([folders / "rod0"], choices=quick).rows[0]
    assert row["status"] == "failed" and "--bench" in row["message"]
    with pytest.raises(ConfigurationError, match="no folder"):
        fit_fleet([folders / "notes.txt"], "aa-050h")


@pytest.mark.long
def test_on_the_command_line(folders, tmp_path, capsys):
    out, checkpoint = tmp_path / "out", tmp_path / "kept"
    arguments = [
        "fit",
        "--fleet",
        str(folders / "rod1"),
        str(folders / "empty"),
        "--bench",
        "aa-050h",
        "--checkpoint",
        str(checkpoint),
        "--quiet",
    ]
    assert main([*arguments, "--out", str(out)]) == 4
    assert "1 fitted" in capsys.readouterr().out
    assert (out / "fleet.csv").exists() and (out / "fleet.nc").exists()
    actuator, _ = load_model(out / "rod1")
    assert float(actuator.coil.R_eddy) == pytest.approx(62, rel=0.01)
    assert json.loads((out / "rod1" / "fit.json").read_text())["converged"]
    assert main([*arguments, "--json"]) == 4
    assert [r["status"] for r in json.loads(capsys.readouterr().out)] == ["fitted", "failed"]


@pytest.mark.long
def test_intervals_on_the_command_line(folders, tmp_path, capsys):
    out = tmp_path / "out"
    files = [str(p) for p in sorted((folders / "rod1").glob("rec_*.csv"))]
    assert main(["fit", *files, "--bench", "aa-050h", "--bootstrap", "20", "--profile", "xi", "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((out / "fit.json").read_text())
    for content in (printed, written):
        assert content["bootstrap"]["parameters"]["coil.R_eddy"]["low"] < 62.5
        assert content["profile"]["parameters"]["mechanics.xi"]["low_found"]
    assert (out / "bootstrap.nc").exists()


KILLED = """
import os, signal, sys
from magjax.cli import main
from magjax.scale.checkpoint import Checkpoint
add = Checkpoint.add
def third(self, *row):
    add(self, *row)
    if len(self.done) == 3 and self.path.suffix == ".profile":
        os.kill(os.getpid(), signal.SIGKILL)
Checkpoint.add = third
main(sys.argv[1:])
"""


@pytest.mark.long
def test_a_killed_profile_goes_on(folders, tmp_path, capsys):
    """kill -9 after three of six ends; the same command again takes them over, and the numbers are those of a whole one."""
    files, kept = [str(p) for p in sorted((folders / "rod1").glob("rec_*.csv"))], tmp_path / "kept"
    command = ["fit", *files, "--bench", "aa-050h", "--profile", "all", "--quiet"]
    ended = subprocess.run([sys.executable, "-c", KILLED, *command, "--checkpoint", str(kept)], cwd=ROOT)
    assert ended.returncode == -signal.SIGKILL
    assert (tmp_path / "kept.profile").read_bytes().count(b"\n") == 4  # the header and three ends
    assert main([*command, "--checkpoint", str(kept), "--out", str(tmp_path / "resumed")]) == 0
    assert "6 chunks in" in (said := capsys.readouterr().out) and "3 from the checkpoint" in said
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    resumed, whole = (json.loads((tmp_path / name / "fit.json").read_text())["profile"] for name in ("resumed", "whole"))
    assert resumed == whole


def test_a_fit_is_kept_where_its_intervals_fail(folders, result, tmp_path, capsys, monkeypatch):
    def failing(*_, **__):
        raise ConfigurationError("no interval today")

    monkeypatch.setattr(importlib.import_module("fitting.fit"), "fit", lambda *_, **__: result)
    monkeypatch.setattr("fitting.scale.profile_intervals", failing)
    files = [str(p) for p in sorted((folders / "rod1").glob("rec_*.csv"))]
    arguments = ["fit", *files, "--bench", "aa-050h", "--profile", "xi", "--out", str(tmp_path / "out"), "--quiet"]
    assert main(arguments) == 2
    assert "no interval today" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["converged"]


@pytest.mark.long
def test_a_defect_is_a_row(folders, quick, monkeypatch):
    def strange(*_, **__):
        raise KeyError("unheard of")

    monkeypatch.setattr("fitting.scale.fleet.fit", strange)
    row = fit_fleet([folders / "rod0"], "aa-050h", choices=quick).rows[0]
    assert row["status"] == "failed" and "KeyError" in row["message"] and "report" in row["message"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["fit", "a.csv", "--bench", "aa-050h", "--workers", "2", "--scheduler", "tcp://x"], "not both"),
        (["fit", "a.csv", "--bench", "aa-050h", "--workers", "0"], "1 or more"),
        (["fit", "a.csv", "--bench", "aa-050h", "--bootstrap", "1"], "2 or more"),
        (["fit", "--fleet", ".", "--bootstrap", "10"], "--fleet goes with"),
        (["fit", "a.csv", "--fleet", "."], "no recordings beside"),
        (["fit", "--fleet", ".", "--check", "a.csv"], "check_"),
        (["fit", "--bench", "aa-050h"], "give recordings"),
        (["fit", "--fleet", "absent", "--bench", "aa-050h"], "no such folder"),
        (["sweep", "--workers", "-1"], "1 or more"),
    ],
)
def test_wrong_use_is_one_line(arguments, word, capsys):
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert word in message and message.count("\n") == 1


def test_the_commands_of_the_page_parse():
    page = (ROOT / "docs" / "scale.md").read_text()
    lines = [line.split()[1:] for line in page.splitlines() if line.startswith("    magjax ")]
    assert len(lines) == 5
    for command, *arguments in lines:
        parser_of(command).parse_args(arguments)
