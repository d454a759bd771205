"""README is true: every command of its tour is typed as it stands there, and what comes back has the shape that it states."""

import re
from pathlib import Path

import pytest

from tests import readme

TEXT = readme.README.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tour")


def follow(folder, kinds):
    """Type every block of these kinds in order; what came back otherwise than stated. Ends what runs beside them."""
    running, wrong = [], []
    try:
        for block in readme.blocks(TEXT):
            if block.kind == "file":
                (folder / block.target).write_text(block.content)
            elif block.kind == "background":
                ((command, expected),) = block.steps()
                process, line = readme.start(command, folder)
                running.append(process)
                wrong.append((command, readme.differs(expected, line, block)))
            elif block.kind in kinds:
                for command, expected in block.steps():
                    wrong.append((command, readme.differs(expected, readme.run(command, folder), block)))
    finally:
        for process in running:
            readme.end(process)
    assert wrong
    return [step for step in wrong if step[1] is not None]


@pytest.mark.long
def test_the_tour_in_order(folder):
    assert follow(folder, ("quick",)) == []


@pytest.mark.long
def test_the_whole_tour_in_order(tmp_path):
    assert follow(tmp_path, ("quick", "long")) == []


def test_every_block_is_marked_and_every_kind_is_known():
    found = readme.blocks(TEXT)
    assert {b.kind for b in found} <= {"quick", "long", "background", "file"} and len(found) >= 7
    assert TEXT.count("```console") == sum(b.kind != "file" for b in found)


def test_lines_are_short_and_links_lead_somewhere():
    written = re.sub(r"```console\n.*?```", "", TEXT, flags=re.S)  # outputs stand as they came
    assert [line for line in written.splitlines() if len(line) >= 120] == []
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (Path(readme.ROOT) / target).exists(), target


def block(within=0.3):
    return readme.Block("quick", "", "", 100, within)


@pytest.mark.parametrize(
    ("stated", "came", "fits"),
    [
        ("R = 62.04 ± 0.2 ohm", "R =  62.1 ± 0.18 ohm", True), ("R = 62.04", "R = 620", False), ("done in 1.2 s", "done in 97 s", True),
        ("drift 1e-9", "drift -2e-9", True), ("fit to use", "NOT fit to use", False), ("one\n\ntwo", "one\ntwo", True), ("one", "one\ntwo", False),
        ("wrote a.csv", "wrote b.csv", False),
    ],
)  # fmt: skip
def test_shapes_are_compared(stated, came, fits):
    assert (readme.differs(stated, came, block()) is None) is fits
