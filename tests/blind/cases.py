"""Suites of concealed benches: what is hidden, how strongly, on which density, with which instruments.

Every case follows from its suite and number alone; its label is written apart from its recordings, and the labels' hash
is printed before a run.
"""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np

from .bench import ConcealedBench

# strong changes the displacement by some per cent, weak by some tenths of a per cent
STRENGTHS = {
    "amplifier_lag": (6e-5, 1.5e-5), "sensor_lag": (1.5e3, 8e3), "transport_delay": (1e-4, 1.5e-5), "excess_loss": (25.0, 3.0),
    "magnetic_aftereffect": (2e-3, 3e-4), "quartic_magnetostriction": (0.15, 0.02), "duffing_stiffness": (0.06, 0.01),
    "delta_e": (0.06, 0.01), "coulomb_friction": (0.02, 0.004), "second_mode": (0.04, 0.008), "structural_damping": (0.04, 0.008),
    "creep": (0.03, 0.005), "inductive_crosstalk": (1e-9, 1.5e-10), "sensor_nonlinearity": (0.05, 0.008), "zero_drift": (2e-6, 4e-7),
    "thermal_drift": (3e-6, 6e-7), "mains_hum": (6e-7, 1e-7), "linear_strain": (0.03, 0.005), "mean_field": (4e-3, 6e-4),
}  # fmt: skip
SUITES = {"dev": 40, "val": 40, "test": 150}
DENSITIES = ("smooth", "lobes", "heavy", "rough")


@dataclasses.dataclass(frozen=True)
class Case:
    """One concealed bench. `effects`: name -> strength; `kind`: null, single, pair, outside, hidden."""

    suite: str
    number: int
    kind: str
    effects: dict
    strength: str
    density: str
    start: str
    truth: dict
    noise: float
    seed: int

    @property
    def name(self) -> str:
        """Folder name; says nothing of what is hidden."""
        return f"{self.suite}-{self.number:03d}"

    def label(self) -> dict:
        """What the scorer may see after the run."""
        return {"name": self.name, "kind": self.kind, "effects": self.effects, "strength": self.strength, "density": self.density, "truth": self.truth}


def make_case(suite: str, number: int) -> Case:
    """The case of a number: every fourth is a null, every eighth a pair, every fifteenth outside the catalogue."""
    seed = list(SUITES).index(suite) * 100_000 + number
    rng = np.random.default_rng(seed)
    names = [n for n in STRENGTHS if n not in ("mean_field", "linear_strain")]
    weak = bool(rng.integers(2))
    density, start = DENSITIES[rng.integers(4)], ("saturated", "demagnetized")[rng.integers(2)]

    def pick(name):
        return float(STRENGTHS[name][weak] * rng.uniform(0.7, 1.4))

    if number % 4 == 0:
        kind, effects = "null", {}
    elif number % 8 == 3:
        a, b = rng.choice(len(names), 2, replace=False)
        kind, effects = "pair", {names[a]: pick(names[a]), names[b]: pick(names[b])}
    elif number % 15 == 2:
        kind, effects = "outside", {"hidden_bump": float(5e-7 * rng.uniform(0.7, 2))}
    elif number % 15 == 7:
        name = ("mean_field", "linear_strain")[rng.integers(2)]
        kind, effects = "hidden", {name: pick(name)}
    else:
        name = names[rng.integers(len(names))]
        kind, effects = "single", {name: pick(name)}
    truth = {"R_eddy": rng.uniform(50, 120), "f0": rng.uniform(320, 600), "xi": rng.uniform(0.35, 0.9), "H_bias": 1.23e4}
    return Case(suite, number, kind, effects, "weak" if weak else "strong", density, start, truth, float(rng.uniform(25e-9, 60e-9)), seed)


def drives_of(case: Case):
    """Nine sines to fit and two recordings to check: frequency, amplitude, offset."""
    rng = np.random.default_rng(case.seed + 7)
    rows = []
    for f in (10, 25, 50, 80, 120, 160, 200, 250, 300):
        amplitude = float(rng.choice([0.4, 0.8]))
        rows.append({"frequency": f, "amplitude": amplitude, "offset": float(rng.uniform(-0.1, 0.15))})
    rows[0]["amplitude"], rows[-1]["amplitude"] = 0.8, 0.8
    check = [
        {"frequency": 65, "amplitude": 0.6, "offset": 0.05},
        {"frequency": 40, "amplitude": 0.45, "offset": 0.0, "extra": ((3, 0.35, 1.0), (5, 0.2, 2.0))},
    ]
    return rows, check


def write_case(case: Case, folder: Path):
    """Recordings (fit_*.csv, check_*.csv) and bench.toml; returns nothing of the label."""
    rng = np.random.default_rng(case.seed + 13)
    folder.mkdir(parents=True, exist_ok=True)
    bench = ConcealedBench(case.truth, case.effects, case.density, case.start, np.random.default_rng(case.seed + 29))
    rows, check = drives_of(case)
    y, current = bench.run(rows + check)
    for k, d in enumerate(rows + check):
        count = y.shape[1]
        time = np.arange(count) * (4 / d["frequency"] / count)
        step = time[1]
        slow = np.cumsum(rng.normal(size=count)) * np.sqrt(step) * 3e-8  # some red noise of the sensor, m per root of s
        reading = y[k] + case.noise * rng.normal(size=count) + slow - slow.mean()
        counts = 2e-4 / 2**16
        reading = np.round(reading / counts) * counts
        command = current[k] + 5e-4 * rng.normal(size=count)
        name = f"fit_{k:02d}.csv" if k < len(rows) else f"check_{k - len(rows):02d}.csv"
        header = "# current: command\ntime_s,current_A,displacement_m"
        np.savetxt(folder / name, np.stack([time, command, reading], axis=1), delimiter=",", header=header, comments="", fmt="%.9g")
    (folder / "bench.toml").write_text(BENCH)


BENCH = """name = "concealed"
[coil]
N_m = 1300
A_m = 2.83e-5
c0 = 1.54e4
H_bias = 1.23e4
R_eddy = 80.0
[magnetostriction]
M_s = 7.87e5
lambda_s = 1.313e-3
l_rod = 5.13e-2
[mechanics]
f0 = 400.0
xi = 0.6
[hysteresis]
levels = 25
[limits]
current_A = 1.0
"""


def seal(suite: str) -> str:
    """SHA-256 over all labels of a suite."""
    text = json.dumps([make_case(suite, k).label() for k in range(SUITES[suite])], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
