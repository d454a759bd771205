"""Every notebook runs as the script it is; long ones in the long run. What is stored beside the sources belongs to them."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
LONG = ("01", "02", "03", "06", "07")
SOURCES = sorted(FOLDER.glob("0*.py"))
RUNS = [pytest.param(p, marks=[pytest.mark.long] if p.name.startswith(LONG) else [], id=p.stem) for p in SOURCES]
EACH = pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.stem)


def stored(source):
    return json.loads(source.with_suffix(".ipynb").read_text())["cells"]


def outputs(source):
    return [o for cell in stored(source) if cell["cell_type"] == "code" for o in cell["outputs"]]


@pytest.mark.parametrize("source", RUNS)
def test_it_runs(source, tmp_path):
    done = subprocess.run(
        [sys.executable, str(source)],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg", "MAGJAX_QUICK": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@EACH
def test_what_it_imports_is_there(source):
    """Also of the long ones, which few runs reach."""
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in ("magjax", "fitting"):
            module = importlib.import_module(node.module)
            for name in node.names:
                found = getattr(module, name.name, None) or importlib.util.find_spec(f"{node.module}.{name.name}")
                assert found is not None, f"from {node.module} import {name.name}"


@EACH
def test_its_cells_are_those_of_the_source(source):
    """`python notebooks/build.py NN` was run after the last change."""
    jupytext = pytest.importorskip("jupytext", reason="wants the notebooks' packages: pip install -e '.[notebooks]'")
    of_source = [(c.cell_type, c.source) for c in jupytext.read(source).cells]
    of_notebook = [(c["cell_type"], "".join(c["source"])) for c in stored(source)]
    for k, pair in enumerate(zip(of_source, of_notebook, strict=True)):
        assert pair[0] == pair[1], f"cell {k} differs: python notebooks/build.py {source.name[:2]}"


@EACH
def test_it_is_short(source):
    assert len(stored(source)) <= 15 and source.read_text().count("# %%") <= 15
    for f in ast.walk(ast.parse(source.read_text())):
        if isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            lines = f.end_lineno - f.lineno + 1
            assert lines <= 5, f"{source.name}:{f.lineno}: a function of {lines} lines"


@EACH
def test_it_was_run_from_top_to_bottom(source):
    counts = [c["execution_count"] for c in stored(source) if c["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))


@EACH
def test_its_outputs_show_something_and_no_error(source):
    kinds = [o["output_type"] for o in outputs(source)]
    assert "stream" in kinds and "error" not in kinds
    assert not [o["text"] for o in outputs(source) if o.get("name") == "stderr"]
    assert any("image/png" in o.get("data", {}) for o in outputs(source)), "no picture"


@EACH
def test_its_outputs_hold_no_object_and_no_path(source):
    """Neither `<matplotlib.legend.Legend at 0x...>` nor where it was run."""
    words = "".join(line for o in outputs(source) for line in (*o.get("text", ()), *o.get("data", {}).get("text/plain", ())))
    assert not re.search(r"\bat 0x[0-9a-f]+|\bText\(|(?<![\w.])/(?:tmp|home|root|work|Users|usr)/", words)
