"""Discipline: who imports whom, what stays free of JAX, what stays fast, what stays documented."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NUMPY_ONLY = (
    *("magjax/control", "magjax/inverse", "magjax/acquire"),
    *(
        f"magjax/{name}.py"
        for name in "pickup recording readers formats columns writers inspection instruments waveforms bench extrema clipping plausibility".split()
    ),
)
SOURCES = sorted([*ROOT.glob("magjax/**/*.py"), *ROOT.glob("fitting/**/*.py")])


def imported(tree, everywhere=True):
    for node in ast.walk(tree) if everywhere else tree.body:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module or ""


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_one_way(path):
    name, tree = str(path.relative_to(ROOT)), ast.parse(path.read_text())
    modules = {m.split(".")[0] for m in imported(tree)}
    if name.startswith("magjax/") and "cli" not in name:
        assert "fitting" not in modules
    if name.startswith(NUMPY_ONLY):
        assert not modules & {"jax", "equinox", "optimistix", "lineax"}
    assert "tests" not in modules


def test_oracle_shares_no_code():
    for path in [*ROOT.glob("tests/oracle/*.py")]:
        assert not {m.split(".")[0] for m in imported(ast.parse(path.read_text()))} & {"magjax", "fitting"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_public_things_are_documented(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} has no docstring"


def test_the_command_line_starts_without_jax():
    code = (
        "import sys; from magjax.cli import main; main(['--help']); assert 'jax' not in sys.modules and 'numpy' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_the_page_of_effects_is_up_to_date():
    from magjax.effects import CATALOGUE
    from magjax.effects.page import page

    written = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    assert written == page(), "run python -m magjax.effects.page"
    assert all(f"## {e.name}" in written for e in CATALOGUE)


@pytest.mark.parametrize(
    "before",
    [
        pytest.param("", marks=pytest.mark.long, id="first"),
        pytest.param("import fitting.fit", marks=pytest.mark.long, id="after fit"),
        pytest.param("from fitting.diagnose import Task", id="after diagnose"),
    ],
)
def test_the_functions_are_what_the_package_gives_whatever_was_imported_before(before):
    code = f"{before}\nfrom fitting import diagnose, fit\nimport fitting\nfor f in (diagnose, fit, fitting.fit, fitting.diagnose): print(type(f).__name__)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == ["function"] * 4
