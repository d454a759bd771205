"""Recordings in which nothing moves are left out where the others say that next to nothing does there."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

import fitting.still
from fitting.diagnosis import Diagnosis
from fitting.still import moving_and_still, word_on
from magjax.bench import load_bench
from magjax.errors import RecordingError
from magjax.recording import Recording

BENCH = load_bench("aa-050h")


def run(name, moves, f=20.0):
    """Four periods of a sine, and a reading that moves by so much, m, in noise of 40 nm."""
    rng, t = np.random.default_rng(sum(map(ord, name))), np.arange(800) / (200 * f)
    drive = np.sin(2 * np.pi * f * t)
    reading = 3e-5 + moves * drive + 4e-8 * rng.standard_normal(len(t))
    return Recording(t, {"current": 0.5 * drive, "displacement": reading}, name=name)


MOVING = [run(f"m{k}", 1e-5) for k in range(4)]


@pytest.mark.parametrize(("moving", "still", "apart"), [(4, 1, 1), (3, 1, 0), (4, 2, 0), (4, 0, 0)])
def test_few_that_show_nothing_are_set_apart(moving, still, apart):
    runs = [*MOVING[:moving], *(run(f"s{k}", 0.0) for k in range(still))]
    those, others = moving_and_still(runs, BENCH)
    assert [r.name for r in others] == [f"s{k}" for k in range(apart)] and len(those) == len(runs) - apart


@pytest.mark.parametrize(("asks", "refused"), [(0.0, False), (3e-7, False), (6e-7, True)])
def test_the_others_say_whether_it_should_have_moved(monkeypatch, asks, refused):
    """A strain that begins at a threshold of M moved 0.2 um of 50 by what the others say: no wire was off."""
    rows = [{"rms_before": np.hypot(asks, 4e-8), "noise_rms": 4e-8, "unit": "m"}]
    monkeypatch.setattr(fitting.still, "check_errors", lambda *a: rows)
    plain, quiet = SimpleNamespace(actuator=None), run("quiet.csv", 0.0)
    if refused:
        with pytest.raises(RecordingError, match=r"quiet\.csv: the displacement does not follow the current"):
            word_on(plain, MOVING, [quiet], BENCH)
    else:
        assert "Nothing but noise moves in quiet.csv" in word_on(plain, MOVING, [quiet], BENCH)


def test_a_diagnosis_of_the_others_says_what_was_left_out(monkeypatch):
    asked = []

    def diagnosed(task, check):
        asked.append([r.name for r in task.recordings])
        return Diagnosis("nothing_missing", "Nothing is missing.")

    module = importlib.import_module("fitting.diagnose")
    monkeypatch.setattr(module, "_diagnosed", diagnosed)
    monkeypatch.setattr(module.Task, "fit", lambda task: asked.append(len(task.recordings)))
    monkeypatch.setattr(module, "word_on", lambda plain, moving, still, bench: f"Left out: {still[0].name}.")
    found = module.diagnose([*MOVING, run("quiet", 0.0)], BENCH)
    assert asked == [4, [r.name for r in MOVING]]
    assert found.message == "Nothing is missing. Left out: quiet."
