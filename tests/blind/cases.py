"""Suites of concealed benches: what is hidden, how strongly, on which density, with which instruments.

dev and practice are to work on (practice drives at many amplitudes and offsets), val chooses thresholds, test is the proof.

A case follows from its suite and number alone. Labels are told apart from recordings, and their hash per suite stands in
SEALS.json before a run: `python -m tests.blind.cases seal` writes it, `... write dev 3 FOLDER` writes one case's recordings.
"""

import argparse
import dataclasses
import functools
import hashlib
import json
from pathlib import Path

import numpy as np

from .generator.bench import ConcealedBench
from .generator.density import KINDS
from .generator.instruments import record
from .strengths import BLOCK_OF_OUTSIDE, FAULTS, HIDDEN, LEVELS, OUTSIDE, VISIBLE

SEALS = Path(__file__).with_name("SEALS.json")
SUITES = {"dev": 1, "val": 2, "test": 3, "practice": 4}
FREQUENCIES = (10, 25, 50, 80, 120, 160, 200, 250, 300)


@dataclasses.dataclass(frozen=True)
class Case:
    """One concealed bench. `kind`: null, decoy, single, pair, outside, hidden or data."""

    suite: str
    number: int
    kind: str
    level: str
    effects: dict
    density: str
    start: str
    truth: dict
    instruments: dict
    drives: tuple
    checks: tuple
    seed: int

    @property
    def name(self) -> str:
        """Folder name; says nothing of what is hidden."""
        return f"{self.suite}-{self.number:03d}"

    def label(self) -> dict:
        """Everything the generator knows."""
        return dataclasses.asdict(self)


def _plan(suite):
    """(kind, names, level) of every case, in an order that tells nothing."""
    rng = np.random.default_rng(7000 + SUITES[suite])
    large = suite == "test"
    rows = [("null", (), "")] * (28 if large else 8) + [("decoy", (k,), "") for k in ("coarse", "noisy", "hum", "clock")] * (
        3 if large else 1
    )
    for name in VISIBLE:
        rows += [("single", (name,), level) for level in (LEVELS if large else (LEVELS[rng.integers(3)],))]
    for _ in range(20 if large else 6):
        a, b = rng.choice(list(VISIBLE), 2, replace=False)
        rows.append(("pair", (str(a), str(b)), LEVELS[rng.integers(1, 3)]))
    outside = [(n, level) for level in ("strong", "mid", "weak") for n in OUTSIDE][: 13 if large else 5]
    rows += [("outside", (n,), level) for n, level in outside]
    rows += [("hidden", (n,), level) for n in HIDDEN for level in (LEVELS + ("mid",) if large else ("mid",))]
    rows += [("data", (f,), "") for f in FAULTS] * (2 if large else 1)
    return [rows[k] for k in rng.permutation(len(rows))]


@functools.cache
def plan(suite: str) -> tuple:
    """The suite's cases in their order, as (kind, names, level)."""
    return tuple(_plan(suite))


def size(suite: str) -> int:
    """How many cases a suite has."""
    return len(plan(suite))


def make_case(suite: str, number: int) -> Case:
    """The case of a number."""
    kind, names, level = plan(suite)[number]
    seed = SUITES[suite] * 100_000 + number
    rng = np.random.default_rng(seed)
    strengths = {**VISIBLE, **HIDDEN, **OUTSIDE}
    effects = {n: _round(_strength(n, strengths[n][LEVELS.index(level)], rng)) for n in names} if level else {}
    truth = {
        "R_eddy": rng.uniform(45, 130),
        "f0": rng.uniform(340, 700),
        "xi": rng.uniform(0.3, 0.9),
        "H_bias": 1.23e4,
        "f2": rng.uniform(650, 1500),
        "xi2": rng.uniform(0.02, 0.08),
    }
    instruments = {
        "samples": 1000,
        "rate": 0.0,
        "noise": _round(rng.uniform(35e-9, 50e-9)),
        "pink": _round(rng.uniform(0, 12e-9)),
        "bits": 16,
        "readback": _round(rng.choice([0.0, 2e-4])),
    }
    if rng.uniform() < 0.1:
        instruments["rate"] = 25600.0
    if kind == "decoy":
        instruments |= {
            "coarse": {"samples": 200, "bits": 12},
            "noisy": {"noise": 1.5e-7, "pink": 6e-8},
            "hum": {},
            "clock": {"rate": 20000.0},
        }[names[0]]
        effects = {"mains_hum": 1.2e-8} if names[0] == "hum" else {}
    if kind == "data":
        instruments |= {"fault": names[0], "rate": 0.0}
    high, low = _round(rng.uniform(0.75, 0.85)), _round(rng.uniform(0.38, 0.5))
    offset = _round(rng.uniform(0.0, 0.12))
    order = rng.permutation([high] * 5 + [low] * 4)
    order[0] = high  # the slowest one spans the plane
    drives = tuple(
        {"frequency": float(f), "amplitude": float(a), "offset": offset} for f, a in zip(FREQUENCIES, order, strict=True)
    )
    if suite == "practice":
        drives = _varied(rng)
    checks = (
        {"frequency": 400.0, "amplitude": 0.6, "offset": offset},
        {"frequency": 20.0, "amplitude": 0.45, "offset": offset, "extra": ((2, 0.3, 1.0), (5, 0.25, 2.0))},
        {
            "frequency": 15.0,
            "amplitude": 0.35,
            "offset": offset,
            "silent": True,
            "extra": ((5, 0.4, 0.0), (6, 1.0, 0.0), (7, 0.4, 0.0)),
        },
    )
    return Case(
        suite, number, kind, level, effects, str(rng.choice(KINDS)), str(rng.choice(["demagnetized", "negative", "positive"])),
        {k: _round(v) for k, v in truth.items()}, instruments, drives, checks, seed,
    )  # fmt: skip


def _varied(rng):
    """Six to nine sines of as many amplitudes and offsets; the slowest spans the plane."""
    count = int(rng.integers(6, 10))
    frequencies = np.sort(rng.choice(FREQUENCIES[1:], count - 1, replace=False))
    rows = [
        {"frequency": float(FREQUENCIES[0]), "amplitude": _round(rng.uniform(0.78, 0.85)), "offset": _round(rng.uniform(0, 0.1))}
    ]
    for f in frequencies:
        rows.append({"frequency": float(f), "amplitude": _round(rng.uniform(0.2, 0.75)), "offset": _round(rng.uniform(-0.2, 0.2))})
    return tuple(rows)


def _strength(name, value, rng):
    # a limit is stronger where it is smaller and acts at once: a narrow range
    return value * (rng.uniform(0.97, 1.03) if name == "amplifier_clipping" else rng.uniform(0.8, 1.25))


def _round(x):
    return float(f"{float(x):.5g}")


def bench_of(case: Case) -> ConcealedBench:
    """The concealed bench itself."""
    return ConcealedBench(case.truth, case.effects, case.density, case.start, np.random.default_rng(case.seed + 10**6))


def recordings_of(case: Case):
    """(name, time, current, displacement) of the recordings to fit, then of those to check."""
    rows = [*case.drives, *case.checks]
    settled = bench_of(case).run(rows)
    rng = np.random.default_rng(case.seed + 2 * 10**6)
    for k, drive in enumerate(rows):
        one = {"turns": settled["turns"], **{name: settled[name][k] for name in ("reading", "command", "current")}}
        name = f"fit_{k:02d}.csv" if k < len(case.drives) else f"check_{k - len(case.drives):02d}.csv"
        yield name, *record(one, drive, case.effects, case.instruments, rng)


def write_case(case: Case, folder: Path):
    """fit_*.csv, check_*.csv and bench.toml in `folder`; nothing of the label."""
    folder.mkdir(parents=True, exist_ok=True)
    kind = "measured" if case.instruments["readback"] else "command"
    for name, time, current, displacement in recordings_of(case):
        header = f"# current: {kind}\ntime_s,current_A,displacement_m"
        np.savetxt(
            folder / name, np.stack([time, current, displacement], axis=1), delimiter=",", header=header, comments="", fmt="%.10g"
        )
    c0 = 1.54e4 * (1.2 if case.instruments.get("fault") == "wrong_c0" else 1)
    (folder / "bench.toml").write_text(BENCH.replace("C0", f"{c0:.6g}"))


BENCH = """name = "aa-050h of this trial"
[coil]
N_m = 1300
A_m = 2.83e-5
c0 = C0
H_bias = 1.23e4
R_eddy = 70.0
[magnetostriction]
M_s = 7.87e5
lambda_s = 1.313e-3
l_rod = 5.13e-2
[mechanics]
f0 = 392.0
xi = 0.7783
[hysteresis]
levels = 25
[limits]
current_A = 1.0
"""


def block_outside(case: Case) -> str:
    """The block where physics outside the catalogue sits."""
    return BLOCK_OF_OUTSIDE[next(iter(case.effects))]


def seal(suite: str) -> str:
    """SHA-256 over all labels of a suite."""
    text = json.dumps([make_case(suite, k).label() for k in range(size(suite))], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def main():
    """Write the seals, or one case's recordings."""
    p = argparse.ArgumentParser(description=__doc__)
    sub = p.add_subparsers(dest="do", required=True)
    sub.add_parser("seal")
    w = sub.add_parser("write")
    w.add_argument("suite", choices=list(SUITES))
    w.add_argument("number", type=int)
    w.add_argument("folder", type=Path)
    options = p.parse_args()
    if options.do == "seal":
        SEALS.write_text(json.dumps({s: {"cases": size(s), "sha256": seal(s)} for s in SUITES}, indent=1) + "\n")
        print(SEALS.read_text())
    else:
        write_case(make_case(options.suite, options.number), options.folder)


if __name__ == "__main__":
    main()
