"""The placebo: the same search on simulations of the final model, its count, and the command that is killed and goes on."""

import dataclasses
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import fitting.search as search_module
from fitting.demo import concealed_actuator, record
from fitting.fit import fit
from fitting.placebo import final_model, placebo
from fitting.scale.bootstrap import model_lines
from fitting.setup import Choices
from magjax.bench import load_bench
from magjax.cli import main
from magjax.effects import CATALOGUE
from magjax.effects.quartic_magnetostriction import QuarticMagnetostriction
from magjax.scale.codec import digest
from magjax.writers import write_recording
from tests.scale.test_fleet import ROOT

DRIVES = ((10, 0.8, 0.1), (80, 0.5, -0.2), (250, 0.8, 0.1))
KEPT = ("quartic_magnetostriction", "linear_strain", "sensor_nonlinearity")
QUICK = Choices(fine=250, without=tuple(e.name for e in CATALOGUE if e.name not in KEPT))


def recorded(effect=None, seed=3):
    rng = np.random.default_rng(seed)
    return [record(concealed_actuator(load_bench("aa-050h"), effect), *drive, rng, f"rec_{drive[0]:03d}.csv") for drive in DRIVES]


@pytest.fixture(scope="module")
def runs():
    return recorded()


@pytest.fixture(scope="module")
def final(runs):
    return fit(runs, "aa-050h", choices=QUICK, refine=False)


@pytest.mark.long
def test_silent_and_resumed(final, runs, tmp_path):
    found = placebo(final, runs, 2, checkpoint=tmp_path / "kept")
    assert found["procedure"] == "search" and (found["runs"], found["false_alarms"], found["named"]) == (2, 0, {})
    assert len(found["highest_z"]) == 2 and 0 < max(found["highest_z"]) < 5.5 and found["screening_alarms"] == 0
    assert len(set(found["highest_z"])) == 2  # each has its own noise
    counted = []
    again = placebo(final, runs, 3, checkpoint=tmp_path / "kept", progress=lambda *a: counted.append(a))
    assert again["highest_z"][:2] == found["highest_z"] and len(again["highest_z"]) == 3
    assert [a[1] for a in counted[1:]] == [3]  # two of them were kept
    other = dataclasses.replace(final, solve_s=1e9, history=(), solution=dataclasses.replace(final.solution, seconds=1e9))
    assert placebo(other, runs, 3, checkpoint=tmp_path / "kept") == again  # the same fit at another speed


@pytest.mark.long
def test_an_alarm_of_the_screening_is_fitted_and_names_nothing(final, runs, monkeypatch):
    monkeypatch.setattr(search_module, "Z_THRESHOLD", 1e-3)
    tried = []
    trials = search_module.try_all
    monkeypatch.setattr(search_module, "try_all", lambda *a: tried.append(a) or trials(*a))
    monkeypatch.setattr("fitting.placebo.Z_THRESHOLD", 1e-3)
    monkeypatch.setattr(search_module, "leaders", lambda candidates: candidates[:1])
    found = placebo(final, runs, 1)
    assert len(tried) == 1 and found["screening_alarms"] == 1 and found["false_alarms"] == 0


@pytest.mark.long
def test_a_search_that_adopts_an_effect_cries_wolf(final, runs, monkeypatch):
    """Where the simulated recordings do hold an effect that the final model lacks, a run names it."""
    more = fit(recorded(QuarticMagnetostriction(0.15)), "aa-050h", choices=QUICK, refine=False)
    lines = np.asarray(more.problem.target.lines)  # as if the final model had made them
    monkeypatch.setattr("fitting.placebo.model_lines", lambda *a: lines)
    others = tuple(e.name for e in CATALOGUE if e.name != "quartic_magnetostriction")
    alone = dataclasses.replace(final, choices=dataclasses.replace(QUICK, without=others))
    found = placebo(alone, runs, 1)
    assert found["false_alarms"] == 1 and found["named"] == {"quartic_magnetostriction": 1} and found["highest_z"][0] > 5.5


@pytest.mark.long
def test_two_processes_search_alike(final, runs):
    assert digest(placebo(final, runs, 2, executor="processes:2")) == digest(placebo(final, runs, 2))


def test_the_final_model():
    def fitted(*effects):
        return SimpleNamespace(actuator=SimpleNamespace(effects=[SimpleNamespace(name=n) for n in effects]))

    base, named, learned = fitted(), fitted("creep"), fitted("creep", "learned_term")
    assert final_model(SimpleNamespace(base=base, repaired=None)) is base
    assert final_model(SimpleNamespace(base=base, repaired=named)) is named
    assert final_model(SimpleNamespace(base=base, repaired=learned)) is base  # what was learned has no law to search beside


def test_simulated_lines_are_those_of_the_fit(final):
    drawn = model_lines(final.problem, final.solution.z)
    apart = (drawn - np.asarray(final.problem.target.lines)) / np.asarray(final.problem.target.deviations)
    assert 0.3 < np.mean(np.abs(apart) ** 2) / 2 < 1.2  # the misfit of the fit


def test_wrong_use_is_one_line(capsys):
    for bench, arguments, word in (
        ("aa-050h", ["--placebo", "-1"], "1 or more"),
        ("aa-050h", ["--workers", "2"], "add --placebo"),
        ("aa-050h", ["--workers", "0"], "1 or more"),
        ("strain-curves", ["--placebo", "2"], "leave it out"),
    ):
        assert main(["diagnose", "a.csv", "--bench", bench, *arguments]) == 2
        message = capsys.readouterr().err
        assert word in message and message.count("\n") == 1


@pytest.mark.long
def test_on_the_command_line(runs, tmp_path, capsys):
    """A scheduler that does not answer costs the placebo, not the diagnosis; searches are kept and told."""
    files = [str(tmp_path / r.name) for r in runs]
    for path, recording in zip(files, runs, strict=True):
        write_recording(tmp_path / recording.name, recording)
    command = ["diagnose", *files, "--bench", "aa-050h", "--quiet"]
    out, kept = tmp_path / "out", str(tmp_path / "kept")
    assert main([*command, "--placebo", "1", "--scheduler", "tcp://127.0.0.1:9", "--out", str(out)]) == 2
    assert "no dask scheduler" in capsys.readouterr().err
    assert json.loads((out / "diagnosis.json").read_text())["placebo"] is None and (out / "report.html").exists()
    ended = subprocess.run([sys.executable, "-m", "magjax", *command, "--placebo", "1", "--checkpoint", kept], cwd=ROOT)
    assert ended.returncode == 0
    assert main([*command, "--placebo", "1", "--checkpoint", kept, "--out", str(out)]) == 0  # another process, the same job
    assert "0 of 1 searches" in capsys.readouterr().out
    assert json.loads((out / "diagnosis.json").read_text())["placebo"]["procedure"] == "search"
    assert "search adopted an effect" in (out / "report.html").read_text()
