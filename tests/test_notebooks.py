"""Every notebook runs as the script it is; long ones in the long run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
LONG = ("02", "03", "06", "07")
SOURCES = [
    pytest.param(p, marks=[pytest.mark.long] if p.name.startswith(LONG) else [], id=p.stem) for p in sorted(FOLDER.glob("0*.py"))
]


@pytest.mark.parametrize("source", SOURCES)
def test_it_runs(source, tmp_path):
    done = subprocess.run(
        [sys.executable, str(source)],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg", "MAGJAX_QUICK": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("source", SOURCES)
def test_it_is_short_and_has_its_notebook(source):
    text = source.read_text()
    assert text.count("# %%") <= 15 and source.with_suffix(".ipynb").exists()
