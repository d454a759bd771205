"""The blind proof's own tests: it shares no code with what it tests, its numerics hold, its labels are the sealed ones."""

import ast
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.blind.baselines import correlation, sparse, stepwise
from tests.blind.cases import SEALS, SUITES, make_case, plan, recordings_of, seal, size, write_case
from tests.blind.generator.bench import ConcealedBench
from tests.blind.generator.coil import shell_matrix
from tests.blind.generator.density import KINDS, SPAN, PlayDensity
from tests.blind.generator.instruments import record
from tests.blind.generator.rod import displacement
from tests.blind.generator.strain import free_displacement, settled_play
from tests.blind.oracle import FILE as ORACLE
from tests.blind.oracle import RIVALS, Sight
from tests.blind.run import diagnose, run_cases
from tests.blind.score import coverage, judge, kept_line, read, read_all, table, wilson
from tests.blind.strengths import GROUPS, HIDDEN, OUTSIDE, VISIBLE

FOLDER = Path(__file__).parent / "blind"
TRUTH = {"R_eddy": 70.0, "f0": 392.0, "xi": 0.78, "H_bias": 1.23e4}
DRIVES = [{"frequency": f, "amplitude": a, "offset": 0.05} for f, a in ((10.0, 0.8), (120.0, 0.4), (300.0, 0.8))]


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module or ""


def test_generator_shares_no_code():
    paths = list(FOLDER.rglob("*.py"))
    assert len(paths) > 10
    for path in paths:
        found = set(imported(path)) - ({"magjax.scale"} if path.name == "run.py" else set())  # where the cases run, no more
        assert not {m.split(".")[0] for m in found} & {"magjax", "fitting", "jax", "equinox", "optimistix", "importlib"}, path


@pytest.mark.parametrize("kind", [k if k == "rough" else pytest.param(k, marks=pytest.mark.long) for k in KINDS])
def test_settled_and_converged(kind):
    bench = ConcealedBench(TRUTH, {}, kind, "demagnetized", np.random.default_rng(3))
    y = bench.run(DRIVES, steps=500, settle=4)["reading"]
    assert np.abs(bench.run(DRIVES, steps=1000, settle=5)["reading"][:, ::2] - y).max() < 8e-9  # cases run at 1000: a quarter
    assert 1e-5 < np.ptp(y) < 7e-5


@pytest.mark.parametrize("name", [
    "magnetic_aftereffect",
    *(pytest.param(n, marks=pytest.mark.long) for n in ("coulomb_friction", "excess_loss", "field_diffusion", "duffing_stiffness")),
])  # fmt: skip
def test_effects_settle(name):
    bench = ConcealedBench(TRUTH, {name: VISIBLE[name][2]}, "heavy", "negative", np.random.default_rng(3))
    first, second = (bench.run(DRIVES[1:], steps=500, settle=s)["reading"] for s in (6, 9))
    assert np.abs(first - second).max() < 2e-9


@pytest.mark.parametrize("name", sorted({**VISIBLE, **HIDDEN, **OUTSIDE}))
def test_every_effect_acts_and_grows(name):
    bench = ConcealedBench(TRUTH, {}, "gauss", "demagnetized", np.random.default_rng(5))
    instruments = {"samples": 250, "rate": 0.0, "noise": 0.0, "pink": 0.0, "bits": 24, "readback": 0.0}

    def reading(effects):
        bench.effects = effects
        settled = bench.run(DRIVES[::2], steps=250, settle=1)
        rng = np.random.default_rng(9)
        rows = [{k: v[n] if np.ndim(v) else v for k, v in settled.items()} for n in range(2)]
        return np.concatenate([record(r, d, effects, instruments, rng)[2] for r, d in zip(rows, DRIVES[::2], strict=True)])

    base = reading({})
    weak, strong = ({**VISIBLE, **HIDDEN, **OUTSIDE}[name][k] for k in (0, 2))
    low, high = (np.sqrt(np.mean((reading({name: s}) - base) ** 2)) for s in (weak, strong))
    assert 3e-9 < low < high < 1e-5


@pytest.mark.parametrize(
    "name", ["duffing_stiffness", *(pytest.param(n, marks=pytest.mark.long) for n in ("delta_e", "coulomb_friction", "end_stop"))]
)
def test_structural_damping_acts_beside_what_is_stepped(name):
    pair = {name: {**VISIBLE, **OUTSIDE}[name][1], "structural_damping": 0.04}
    bench = ConcealedBench(TRUTH, pair, "gauss", "demagnetized", np.random.default_rng(5))
    M = bench.run(DRIVES[::2], steps=500, settle=1)["M"]
    frequency = np.array([d["frequency"] for d in DRIVES[::2]])
    free = free_displacement(M, M, {})
    both, alone, base, damped = (
        displacement(free, M, frequency, TRUTH, e)
        for e in (pair, {name: pair[name]}, {}, {"structural_damping": 0.04})
    )  # fmt: skip
    acts = np.sqrt(np.mean((damped - base) ** 2))
    assert np.sqrt(np.mean((both - alone - (damped - base)) ** 2)) < 0.3 * acts


def test_static_limit_is_the_preisach_integral():
    density = PlayDensity("gauss", 7e5, np.random.default_rng(0), radii=60)
    plays, M, _ = density.evaluate(density.start((1,), "negative"), np.array([SPAN]))
    assert abs(M[0] - 7e5) < 1e-3 * 7e5
    path = np.array([2e4, -1e4, 1.5e4, -5e3, 1e4])
    relays_s = np.linspace(-SPAN, SPAN, 2401)[:-1] + SPAN / 2400
    state = np.ones((60, 2400))
    plays = density.start((1,), "positive")
    for H in path:  # relays switched one by one
        state[relays_s[None] + density.radii[:, None] <= H] = 1
        state[relays_s[None] - density.radii[:, None] >= H] = -1
        plays, M, _ = density.evaluate(plays, np.array([H]))
        assert abs((state.ravel() * density.slope).sum() * 0.5 * density.step - M[0]) < 3e-3 * 7e5


def test_memory_wipes_out():
    density = PlayDensity("rough", 7e5, np.random.default_rng(0))
    plays = density.start((2,), "demagnetized")
    for H in ((2e4, 2e4), (-2e4, -2e4), (5e3, 8e3), (0.0, -3e3), (2.1e4, 2.1e4)):
        plays, M, _ = density.evaluate(plays, np.array(H))
    assert M[0] == M[1]


def test_shells_hold_the_lag_of_a_thin_cylinder():
    K = shell_matrix(8)
    assert np.allclose(K, K.T) and abs(K.mean() - 1) < 1e-12 and np.linalg.eigvalsh(K).min() > 0
    exact = (1 - (np.arange(8) + 0.5) / 8) / 0.5  # H_app - H(r) of a uniform dB/dt falls as 1 - r^2
    assert np.allclose(K.mean(axis=1), exact, atol=0.02)


def test_play_of_a_sine():
    x = np.sin(2 * np.pi * np.arange(400) / 400)[None]
    assert abs(settled_play(x, 0.2).max() - 0.8) < 1e-12 and abs(settled_play(x, 0.2).min() + 0.8) < 1e-12


def test_suites_hold_what_they_promise():
    kinds = [row[0] for row in plan("test")]
    assert size("test") >= 150 and kinds.count("null") + kinds.count("decoy") >= 40
    assert {n for k, names, _ in plan("test") if k == "single" for n in names} == set(VISIBLE)
    assert not set(VISIBLE) & set(HIDDEN) and {n for g in GROUPS for n in g} <= {**VISIBLE, **HIDDEN}.keys()


@pytest.mark.parametrize("suite", list(SUITES))
def test_labels_are_the_sealed_ones(suite):
    assert json.loads(SEALS.read_text())[suite] == {"cases": size(suite), "sha256": seal(suite)}


def test_recordings_follow_from_the_case_and_keep_the_contract(tmp_path):
    case = next(
        make_case("dev", k)
        for k in range(size("dev"))
        if plan("dev")[k][0] == "null" and not make_case("dev", k).instruments["rate"]
    )
    write_case(case, tmp_path)
    files = sorted(p.name for p in tmp_path.glob("*.csv"))
    assert files == [f"check_{k:02d}.csv" for k in range(3)] + [f"fit_{k:02d}.csv" for k in range(9)]
    lines = (tmp_path / "fit_00.csv").read_text().splitlines()
    assert lines[0].startswith("# current:") and lines[1] == "time_s,current_A,displacement_m" and len(lines) == 4002
    again = next(iter(recordings_of(case)))
    assert np.allclose(np.loadtxt(tmp_path / "fit_00.csv", delimiter=",", skiprows=2).T, again[1:], rtol=1e-9, atol=1e-12)


def test_scorer():
    case = next(make_case("dev", k) for k in range(size("dev")) if plan("dev")[k][0] == "single")
    name = next(iter(case.effects))
    said = {"verdict": "attributed", "effects": [{"name": name}], "groups": [], "absorbed": []}
    assert judge(case, said) == "right"
    assert judge(case, {**said, "effects": [{"name": name}, {"name": "linear_strain"}]}) == "extra"
    assert judge(case, {**said, "verdict": "group", "effects": [], "groups": [[name, "linear_strain"]]}) == "group"
    assert judge(case, {**said, "verdict": "nothing_missing", "effects": []}) == "silent"
    assert judge(case, None, 3) == "data_problem" and judge(case, None, 1) == "failed"
    low, high = wilson(40, 40)
    assert 0.91 < low < 0.92 and high > 0.999


@pytest.mark.parametrize("suite", ["dev", "val", "test"])
def test_the_oracle_has_seen_every_effect(suite):
    seen = json.loads(ORACLE.read_text())
    cases = [make_case(suite, k) for k in range(size(suite))]
    assert {c.name: set(c.effects) for c in cases if c.effects} == {n: set(z) for n, z in seen.items() if n.startswith(suite)}


def test_the_table_tells_by_what_the_oracle_saw():
    """What it sees at less than 10 does not count among what it sees at 10 or more; of a pair the lesser one does."""
    seen = json.loads(ORACLE.read_text())
    cases = [c for c in (make_case("test", k) for k in range(size("test"))) if c.name in seen and c.kind in ("single", "pair")]
    found = {"verdict": "attributed", "groups": [], "absorbed": [], "check": [], "unknown": None}
    rows = [
        (
            c,
            found | {"effects": [{"name": n, "confidence": 0.95} for n, z in seen[c.name].items() if z >= 10]},
            {"status": 0, "seconds": 1.0},
        )
        for c in cases
    ]
    text = table("test", rows)
    for kind in ("single", "pair"):
        clear = sum(c.kind == kind and min(seen[c.name].values()) >= 10 for c in cases)
        assert f"{kind}s of z = 10 or more: right or in a group {clear}/{clear}: " in text
    assert "| 0 to 5 | 2 | 0 | 0 | 0 | 0 | 2 | 0/2: " in text  # pairs of which one cannot be seen


def test_the_table_tells_what_stands_out_from_its_nearest_rival():
    """Two names where one would do count as a group, and only what the oracle tells from its nearest rival is asked for."""
    left = json.loads(RIVALS.read_text())
    cases = [c for c in (make_case("test", k) for k in range(size("test"))) if c.kind == "single"]
    assert {c.name for c in cases} == set(left)
    apart = [c for c in cases if min(left[c.name].values()) >= 5]
    assert 0 < len(apart) < len(cases)
    said = {"verdict": "attributed", "groups": [], "absorbed": [], "check": [], "unknown": None}
    rows = [
        (c, said | {"effects": [{"name": n, "confidence": 0.95} for n in c.effects]}, {"status": 0, "seconds": 1.0}) for c in cases
    ]
    grouped = said | {"verdict": "group", "effects": [], "groups": [[*apart[0].effects, "linear_strain"]]}
    rows[cases.index(apart[0])] = (apart[0], grouped, {"status": 0, "seconds": 1.0})
    assert f"beyond their nearest rival: exactly named {len(apart) - 1}/{len(apart)}: " in table("test", rows)


@pytest.fixture(scope="module")
def sight():
    case = next(make_case("dev", k) for k in range(size("dev")) if plan("dev")[k][0] == "null")
    return Sight(dataclasses.replace(case, drives=(case.drives[0], case.drives[4], case.drives[8])))


def test_oracle_sees_noise_as_noise(sight):
    noise = np.random.default_rng(0).normal(size=len(sight.sigma))
    assert abs(sight.z(noise) ** 2 / len(noise) - 1) < 0.1


def test_oracle_is_blind_to_what_the_base_can_be(sight):
    shifted = dataclasses.replace(sight.case, truth={**sight.case.truth, "R_eddy": 1.005 * sight.case.truth["R_eddy"]})
    other = Sight(shifted)
    trace = np.tile(other.base - sight.base, (1, 4)).ravel() / sight.sigma
    assert sight.z(trace) < 0.05 * np.linalg.norm(trace)
    drift = sight.trace({"zero_drift": 3e-7})
    assert sight.z(drift) > 0.2 * np.linalg.norm(drift)


def test_baselines_choose(sight):
    rng = np.random.default_rng(0)
    S = rng.normal(size=(400, 4))
    e = 3 * S[:, 2] + rng.normal(size=400)
    names = ["a", "b", "c", "d"]
    assert "c" in stepwise(e, S, names) and correlation(e, S, names) == {"c"} and "c" in sparse(e, S, names)
    assert correlation(rng.normal(size=400), S, names) == set()


STAND_IN = """
import os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[-1]).parent
mark = folder.parent / f"{folder.name}.first"
if not mark.exists():
    mark.write_text(str(os.getpid()))
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)
"""


def ended(process, patience_s: float = 10.0) -> bool:
    """Whether a process, a folder in /proc, is gone soon, or dead and not yet reaped by whoever inherited it."""
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        try:
            if (process / "stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.long
def test_a_killed_worker_costs_its_case_only(tmp_path):
    """A command that kills its worker at first, for one of two cases: it ends with the worker, and the case is run again."""
    (tmp_path / "command.py").write_text(STAND_IN)
    (tmp_path / "dev-001.first").write_text("")  # this case kills none
    command = (sys.executable, str(tmp_path / "command.py"))
    outcome = run_cases("dev", (0, 1), tmp_path, "processes:2", command=command)
    assert outcome.lost == 1 and [(r["name"], r["status"]) for r in outcome.results] == [("dev-000", 0), ("dev-001", 0)]
    assert outcome.results == [json.loads((tmp_path / f"dev-00{k}" / "done.json").read_text()) for k in (0, 1)]
    assert ended(Path(f"/proc/{(tmp_path / 'dev-000.first').read_text()}"))
    again = run_cases("dev", (0, 1, 2), tmp_path, until=0.0, command=("false",))  # done cases too wait for no time
    assert [r["status"] for r in again.results] == ["not started"] * 3
    assert run_cases("dev", (0, 1), tmp_path, command=("false",)).results == outcome.results  # nothing is run twice


def test_sample_through_the_command_line(tmp_path):
    """Five recordings of a null, as the runner does it; the whole suites are long."""
    number = next(k for k in range(size("dev")) if plan("dev")[k][0] == "null" and not make_case("dev", k).instruments["rate"])
    case = make_case("dev", number)
    case = dataclasses.replace(
        case, drives=case.drives[::2], checks=case.checks[1:2], instruments={**case.instruments, "samples": 250}
    )
    write_case(case, tmp_path)
    ended = diagnose(tmp_path, tmp_path / "result", 300.0)
    assert ended["status"] == 0, ended["last"]
    said = json.loads((tmp_path / "result" / "diagnosis.json").read_text())
    assert judge(case, said) == "right", said["message"]
    kept = json.loads(kept_line(case.name, ended, said))["diagnosis"]  # a row of --keep scores the same
    assert judge(case, kept) == "right" and list(coverage(case, kept)) == list(coverage(case, said)) and len(kept["check"]) == 1


def test_rows_of_another_suite_are_refused(tmp_path):
    (tmp_path / "rows.jsonl").write_text(kept_line("val-003", {"status": 0, "seconds": 1.0}, None) + "\n")
    assert [case.name for case, *_ in read("val", tmp_path / "rows.jsonl")] == ["val-003"]
    with pytest.raises(SystemExit, match="no case of test"):
        list(read("test", tmp_path / "rows.jsonl"))


def test_a_case_counts_once(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).write_text(kept_line("val-003", {"status": 0, "seconds": 1.0}, None) + "\n")
    assert len(read_all("val", [tmp_path / "one"])) == 1
    with pytest.raises(SystemExit, match="val-003 stands in .*one and in .*two"):
        read_all("val", [tmp_path / "one", tmp_path / "two"])
