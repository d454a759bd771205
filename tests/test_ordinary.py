"""The ordinary is quick: help imports nothing heavy, a terminal is never left silent, and a pipe sees nothing but the result."""

import io
import json
import os
import resource
import subprocess
import sys

import pytest

from magjax.cli import COMMANDS, waiting
from magjax.cli.runtime import Progress
from tests.studies.silence import silence

HEAVY = {"jax", "equinox", "optimistix", "control", "matplotlib", "scipy", "xarray", "pandas", "rich", "numpy"}


def modules_after(calls):
    code = f"""
import contextlib, io, json, sys
from magjax.cli import main
for call in {calls!r}:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(call)
print(json.dumps(sorted({{m.split(".")[0] for m in sys.modules}})))
"""
    return set(json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout))


def test_help_imports_nothing_heavy():
    assert not modules_after([["--help"]]) & HEAVY


def test_no_commands_help_imports_anything_heavy():
    assert not modules_after([[command, "--help"] for command in COMMANDS]) & HEAVY


def test_help_takes_less_than_a_quarter_of_a_second():
    def work():
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    spent = []
    for _ in range(3):
        before = work()
        subprocess.run([sys.executable, "-m", "magjax", "--help"], capture_output=True, check=True)
        spent.append(work() - before)
    assert min(spent) < 0.25  # of the processor: the clock on the wall belongs to whoever else runs


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals on Windows")
def test_a_terminal_sees_a_sign_of_life_and_then_the_whole_result():
    _, _, status, text = silence([sys.executable, "-m", "magjax", "ports", "--json"])
    assert status == 0
    erased = text.rindex("\x1b[2K")  # the spinner's line, before the result stands on it
    assert "magjax ports" in text[:erased] and isinstance(json.loads(text[erased + 4 :]), list)


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals on Windows")
def test_a_failure_on_a_terminal_is_one_whole_line():
    _, _, status, text = silence(
        [sys.executable, "-m", "magjax", "export", "no-such-file.csv", "--bench", "aa-050h", "--out", "x.csv"]
    )
    assert status == 3 and "magjax export: no-such-file.csv: no such file" in text and "Traceback" not in text


def test_a_pipe_and_quiet_see_nothing(capsys):
    with waiting.Waiting("magjax test") as shown:
        waiting.tell("doing something")
        assert shown._shown is None and sys.stdout is not None
    done = subprocess.run(
        [sys.executable, "-m", "magjax", "ports"], capture_output=True, text=True, env={**os.environ, "TERM": "xterm"}
    )
    assert done.returncode == 0 and done.stderr == ""


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_the_first_text_ends_the_spinner_and_frees_the_streams(monkeypatch):
    out, err = Terminal(), Terminal()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    with waiting.Waiting("magjax test"), Progress(quiet=False) as progress:
        progress("fit", 3, 1.25)
        assert sys.stdout is not out
        print("the result")
        assert sys.stdout is out and sys.stderr is err
        waiting.tell("nobody listens")
    assert out.getvalue() == "the result\n"


def test_progress_names_step_and_misfit(monkeypatch):
    told = []
    monkeypatch.setattr("magjax.cli.runtime.tell", told.append)
    Progress(quiet=False)("fit", 3, 1.25)
    Progress(quiet=False)("reading")
    Progress(quiet=True)("silent")
    assert told == ["fit: step 3, chi2/N = 1.25", "reading"]
