"""Pages written from the code: up to date, complete, and nothing that a real result holds is missing from them."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pytest

from magjax import bench
from magjax.cli import COMMANDS
from magjax.cli.pages import commands, parameters, results
from magjax.effects import CATALOGUE, page
from magjax.page import extent, number, table

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"effects": page, "parameters": parameters, "commands": commands, "results": results}


@pytest.mark.parametrize("name", PAGES)
def test_the_written_page_is_up_to_date(name):
    module = PAGES[name]
    written = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    assert written == module.page(), f"the code has moved on: run python -m {module.__name__}"


def test_check_mode_says_what_to_type(tmp_path, capsys):
    stale = tmp_path / "parameters.md"
    stale.write_text("old")
    assert parameters.main(["--check", str(stale)]) == 1
    assert "python -m magjax.cli.pages.parameters" in capsys.readouterr().err
    assert parameters.main([str(stale)]) == 0 and parameters.main(["--check", str(stale)]) == 0
    assert parameters.main(["--check", str(tmp_path / "absent.md")]) == 1


def test_every_parameter_and_every_bench_key_is_on_the_page():
    text = parameters.page()
    for block, keys in bench.BLOCK_KEYS.items():
        assert all(f"`{key}`" in text or f"`{block}.{key}`" in text for key in keys)
    for effect in CATALOGUE:
        assert all(f"`{effect.name}.{name}`" in text for name in effect.parameters())
    assert set(parameters.SETTINGS) - {"sensor.tau", "sensor.order2"} == {
        "name",
        *(f"{section}.{key}" for section, keys in bench.OTHER_KEYS.items() for key in keys),
    }
    assert set(parameters.COLUMNS) == set(bench.COLUMN_KEYS)


def test_symbols():
    assert [parameters.symbol(n) for n in ("R_eddy", "xi2", "tau_L", "f0", "order2", "rate_knee")] == [
        "R<sub>eddy</sub>", "ξ<sub>2</sub>", "τ<sub>L</sub>", "f<sub>0</sub>", "order2", "rate knee",
    ]  # fmt: skip


def test_tables_survive_what_stands_in_them():
    assert table(("a",), [("x | y\nz",)])[-1] == "| x \\| y z |"
    assert (number(None), number(float("inf")), extent((0.0, float("inf"))), extent(None)) == ("", "", "0 ..", "")


def test_every_command_and_every_argument_is_explained():
    made = commands.parsers()
    assert {p.prog.split()[1] for p in made} == set(COMMANDS)
    for parser in made:
        assert parser.description and parser.epilog.startswith(f"example: {parser.prog}"), parser.prog
        for action in parser._actions:
            assert action.help, f"{parser.prog} {action.dest} has no help"


def test_arguments_are_shown_as_typed():
    p = argparse.ArgumentParser()
    given = [
        p.add_argument("files", nargs="+"),
        p.add_argument("--check", nargs="+"),
        p.add_argument("--kind", choices=("a", "b")),
        p.add_argument("--rate", type=float, default=0.0),
    ]
    assert [commands.written(a) for a in given] == ["`FILES...`", "`--check CHECK...`", "`--kind a|b`", "`--rate RATE`"]
    assert commands.default(given[-1]) == "0" and commands.default(given[1]) == ""


def test_a_key_without_meaning_and_a_meaning_without_key_are_named():
    with pytest.raises(LookupError, match="new_key has no meaning"):
        results.documented({"new_key": 1}, {}, "fit.json", {})
    with pytest.raises(LookupError, match="old_key is no key"):
        results.documented({}, {"old_key": ""}, "fit.json", {})


def explained(content, *meanings):
    known = set().union(*meanings)
    return [path for path, _ in results.keys(content) if path not in known and not path.startswith(("base.", "repaired."))]


@pytest.mark.long
def test_a_real_diagnosis_holds_no_key_that_the_page_lacks(tmp_path):
    command = [sys.executable, "-m", "magjax", "demo", "--out", str(tmp_path), "--quiet"]
    assert subprocess.run(command, capture_output=True).returncode == 0
    content = json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text())
    assert not explained(content, results.DIAGNOSIS, results.INNER)
    for part in ("base", "repaired"):
        assert not explained(content[part], results.FIT, results.INNER)
    assert not explained(json.loads((tmp_path / "fit" / "fit.json").read_text()), results.FIT, results.INNER)
    assert not explained(json.loads((tmp_path / "fit" / "model.json").read_text()), results.MODEL)
