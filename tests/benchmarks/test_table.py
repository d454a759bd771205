"""README's table of speed is results.json: every number of a row, to the digits shown; what misses its bar says so."""

import json
import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
RESULTS = json.loads((HERE / "results.json").read_text())
README = (HERE.parents[1] / "README.md").read_text(encoding="utf-8")

# first words of a row -> the group and the beginnings of the keys whose numbers stand there, in their order
ROWS = {
    "one trajectory over": ("single", ["time over compiled loop"]),
    "diffrax, solve_ivp": ("single", ["diffrax over ours", "solve_ivp over ours", "relay grid over ours"]),
    "batch of 64 and 1000": ("batch", ["batch of 64", "batch of 1000"]),
    "exponent of the cost": ("batch", ["exponent of the cost"]),
    "jvp, Jacobian column": ("derivatives", ["jvp", "Jacobian column", "reverse"]),
    "Jacobian of a fit": ("jacobian", ["205 unknowns, over", "1089 unknowns, over"]),
    "trial steps of a fit": ("grids", ["alone, over", "14 periods, diffusion, over"]),
    "static value and gradient": ("static", ["L = 25: value", "L = 200: value"]),
    "its peak memory at T = 1e6": ("memory", ["T = 1e6"]),
    "its memory at T = 10,000": ("memory", ["T = 10,000, L = 25", "T = 10,000, L = 200"]),
    "sweep of 200 x 20": ("sweep", ["4000 trajectories", "peak memory"]),
    "bisection over": ("inversion", ["bisection over", "pure, us", "compiled, us"]),
    "l1 design": ("l1", ["l1 design"]),
    "joint fit": ("fit", ["cold: compilation", "cached: compilation", "solve", "chi2/N"]),
}
NEARLY = 0.05  # a bar missed by less is "at it"


def table():
    """The rows of the table under **Speed**: (what, measured, bar)."""
    lines = README[README.index("**Speed**") :].split("\n\n")[1].splitlines()
    return [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines[2:]]


def kept(what):
    """The keys of results.json that a row states, with their values."""
    group, beginnings = next(row for words, row in ROWS.items() if what.startswith(words))
    return [next((k, v) for k, v in RESULTS[group].items() if k.startswith(b)) for b in beginnings]


def stated(text):
    """Numbers of a cell as (lowest, highest, half a unit of the last digit): "2.7-3.1" is a range."""
    for low, high in re.findall(r"([\d.]+)(?:-([\d.]+))?(?![\d.]*e)", text):
        digits = len(low.partition(".")[2])
        unit = 10.0**-digits if "." in low or not low.endswith("0") else 10.0 ** (len(low) - len(low.rstrip("0")))
        yield float(low), float(high or low), 0.5 * unit


def missed(key, value):
    """By which share a value misses the bar that its key names; nothing where it keeps it."""
    bar = re.search(r"\(bar ([<>]=?) ([\d.]+)\)", key)
    if bar is None:
        return 0.0
    excess = value / float(bar[2]) - 1
    return max(0.0, excess if "<" in bar[1] else -excess)


@pytest.mark.parametrize("row", table(), ids=lambda row: row[0][:20])
def test_a_row_states_what_was_measured(row):
    what, measured, bar = row
    numbers = list(stated(measured))
    found = kept(what)
    assert len(numbers) == len(found), f"{measured} against {[k for k, _ in found]}"
    for (low, high, half), (key, value) in zip(numbers, found, strict=True):
        assert low - half * 1.001 <= value <= high + half * 1.001, f"README states {measured}, results.json {key}: {value:.4g}"
        bars = re.search(r"\(bar [<>]=? ([\d.]+)\)", key)
        assert bars is None or bars[1] in bar, f"the bar of {key} is not in the row: {bar}"


@pytest.mark.parametrize("row", table(), ids=lambda row: row[0][:20])
def test_a_missed_bar_is_told(row):
    what, _, bar = row
    worst = max(missed(key, value) for key, value in kept(what))
    assert ("not reached" in bar) == (worst > NEARLY), f"{what}: the worst misses its bar by {worst:.0%}, the row says: {bar}"
    assert worst == 0 or "not reached" in bar or "at it" in bar


def test_every_bar_measured_stands_in_the_table():
    """Of the groups of the table none of the numbers that have a bar is left out; `static` shows two of its levels."""
    rows = [kept(what) for what, _, _ in table()]
    shown = {key for row in rows for key, _ in row}
    groups = {next(r for w, r in ROWS.items() if what.startswith(w))[0] for what, _, _ in table()} - {"static", "memory"}
    assert {key for group in groups for key in RESULTS[group] if "(bar" in key} <= shown
