"""The investigation's loop with a scripted diagnosis; the source's own check; and (long) the whole of it on a concealed bench."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from magjax.acquire.campaign import SETTINGS, Campaign, Plan
from magjax.acquire.investigation import Budget, Investigation, deciders, judge
from magjax.acquire.log import LogWriter
from magjax.acquire.source_check import check_source
from magjax.bench import load_bench
from magjax.errors import ConfigurationError

QUICK = {**SETTINGS, "samples": 100, "periods": 2, "settle": 1, "demagnetize": False}
PLAN = Plan(QUICK, ({"frequency": [50, 100], "amplitude": 0.4},))


def scripted(*verdicts):
    """An `analyse` that answers with these verdicts in turn, and what it was asked."""
    asked = []

    def analyse(files, checks, number):
        asked.append([os.path.basename(f) for f in files])
        drive = {"kind": "sine", "frequency_Hz": 80.0 + 40 * number, "amplitude": 0.5, "offset": 0.0, "periods": 4}
        return {
            "verdict": verdicts[number], "message": f"verdict {verdicts[number]}.", "effects": [], "groups": [], "check": [],
            "next_experiment": {"text": "again", "drive": drive} if verdicts[number] == "group" else None,
        }  # fmt: skip

    return analyse, asked


def campaign(port, folder, **changes):
    return Campaign(port, load_bench("aa-050h"), folder, 0.9, dict(QUICK), {"bench": "aa-050h"}, say=lambda text: None, **changes)


def test_records_what_the_diagnosis_asks_for_and_goes_on_where_it_ended(emulate, tmp_path):
    port = emulate("--fast")["port"]
    analyse, asked = scripted("group", "group", "nothing_missing")
    state = Investigation(campaign(port, tmp_path), analyse, Budget(5, 10), PLAN).run()
    assert state["ended"]["how"] == "budget spent" and len(asked) == 2 and len(state["recordings"]) == 5
    assert asked[1] == [*asked[0], "x00_sine_80Hz_0.5A.mjlog"] and state["steps"][0]["asked_for"].startswith("0.5 A at 80 Hz")
    assert state["steps"][0]["source"]["verdict"] == "follows"
    state = Investigation(campaign(port, tmp_path), analyse, Budget(9, 10), PLAN).run()
    assert state["ended"]["how"] == "settled" and len(asked) == 3 and len(state["recordings"]) == 6
    assert all(r["tries"] == 0 for r in state["recordings"][:5])
    report = (tmp_path / "report.html").read_text()
    assert report.count("<h2>Step") == 3 and "x01_sine_120Hz" in report
    with pytest.raises(ConfigurationError, match="about bench aa-050h"):
        other = campaign(port, tmp_path)
        other.bench = load_bench("rod-eddy")
        Investigation(other, analyse, Budget())


def test_a_budget_of_minutes_ends_it(emulate, tmp_path):
    analyse, asked = scripted("group", "group")
    clock = iter(np.arange(100) * 100.0)
    state = Investigation(
        campaign(emulate("--fast")["port"], tmp_path), analyse, Budget(20, 1), PLAN, clock=lambda: next(clock)
    ).run()
    assert state["ended"]["how"] == "budget spent" and len(asked) == 1


def test_nothing_usable_and_wrong_budgets_are_told(emulate, tmp_path, monkeypatch):
    analyse, asked = scripted()
    made = campaign(emulate("--fast")["port"], tmp_path)
    monkeypatch.setattr(Campaign, "problems", lambda self, path, entry: ["the sensor is unplugged"])
    state = Investigation(made, analyse, Budget(4, 10), PLAN).run()
    assert state["ended"]["how"] == "no usable recording" and "sensor is unplugged" in state["ended"]["message"] and not asked
    for wrong in ((0, 10), (5, 0), (5, float("nan"))):
        with pytest.raises(ConfigurationError, match="give two or more"):
            Budget(*wrong)
    for content in ("[]", "{}", "torn {"):
        (tmp_path / "investigation.json").write_text(content)
        with pytest.raises(ConfigurationError, match="remove it to begin anew"):
            Investigation(made, analyse, Budget(4, 10), PLAN)


@pytest.mark.parametrize("rate_max", [2e5, 1e4, 9993.753904])
def test_the_usual_drives_suit_the_rate_of_the_device(tmp_path, monkeypatch, rate_max):
    """The sketch as it is samples at 10 kHz: 400 Hz would leave 25 samples a period."""
    monkeypatch.setattr(Campaign, "rate_max", lambda self: rate_max)
    first, checks = Investigation(campaign("no port", tmp_path), None, Budget(9, 10))._first_entries()
    share = min(1.0, rate_max / 16000)
    assert [e.frequency for e in (*first, *checks)] == pytest.approx([f * share for f in (10, 20, 50, 100, 200, 300, 400, 150)])
    assert all(e.rate <= rate_max and e.rate / e.frequency >= 40 - 1e-6 for e in (*first, *checks))


def log_of(path, frequency, answer, noise=2.0):
    """A log whose current is `answer`(w) times its command, in counts of 5e-5 A."""
    width, periods = 200, 6
    k = np.arange(width * periods)
    rng = np.random.default_rng(int(frequency))
    gain = answer(2 * np.pi * frequency)
    current = 8000 * np.abs(gain) * np.sin(2 * np.pi * k / width + np.angle(gain)) + noise * rng.standard_normal(len(k))
    channels = [{"name": "current", "unit": "A", "scale": 5e-5}, {"name": "displacement", "unit": "um", "scale": 1e-3}]
    writer = LogWriter(path, {"device": "d", "channels": channels})
    command = {"scale": 5e-5, "repeats": 0, "samples": width, "amplitude": 8000, "offset": 0, "factor": 1.0}
    writer.event("start", segment=0, rate_Hz=frequency * width, frequency_Hz=frequency, command=command)
    writer.data(0, 0, (0, 1), np.round(np.stack([current, current], axis=1)).astype("<i2"))
    writer.close()
    return path


@pytest.mark.parametrize(
    ("answer", "verdict"),
    [
        (lambda w: 1.0, "follows"),
        (lambda w: 0.98, "follows"),
        (lambda w: 1 / (1 + 5e-5j * w), "amplifier_lag"),
        (lambda w: np.exp(-5e-5j * w), "delay"),
        (lambda w: 1 / (1 + 1e-6j * w), "group"),
        (lambda w: 1 / (1 + 5e-5j * w) / (1 + 1e-4j * w) ** 3, "unknown"),
    ],
)
def test_the_source_is_judged_by_command_and_shunt(tmp_path, answer, verdict):
    files = [log_of(tmp_path / f"{f}.mjlog", f, answer) for f in (10, 50, 150, 300)]
    found = check_source(files)
    assert found["verdict"] == verdict, found
    if verdict == "amplifier_lag":
        assert abs(found["tau"] - 5e-5) < 4 * found["stderr"] < 5e-7
        assert found["decided_by"][0]["file"].endswith("300.mjlog")


def test_who_decided_and_what_both_say_together():
    rows = lambda *chi2: {"recordings": [{"file": f"a/r{k}.mjlog", "chi2_per_sample": c} for k, c in enumerate(chi2)]}
    content = {
        "verdict": "nothing_missing",
        "message": "nothing.",
        "effects": [],
        "groups": [],
        "check": [],
        "base": rows(2, 30, 1),
        "repaired": rows(1, 1, 1),
    }
    assert deciders(content) == ["r1.mjlog"]
    source = {"verdict": "amplifier_lag", "tau": 5e-5, "stderr": 1e-7, "decided_by": [{"file": "a/r1.mjlog"}]}
    said = judge(content, source)
    assert said["verdict"] == "attributed" and said["settled"] and "amplifier_lag was decided by r1.mjlog" in said["message"]
    badly = judge({**content, "check": [{"noise_rms": 1.0, "rms_after": 9.0}]}, None)
    assert not badly["settled"]
    assert judge(content, None)["settled"] and not judge({**content, "ended_after": 15.0}, None)["settled"]


@pytest.mark.long
def test_names_a_concealed_sensor_filter_and_amplifier_lag(emulate, tmp_path):
    hidden = ["--hide", "sensor_lag:tau=1e-4,order2=0.5", "--hide", "amplifier_lag:tau=5e-5"]
    port = emulate("--fast", *hidden, bench="aa-050h")["port"]
    command = [
        sys.executable,
        "-m",
        "magjax",
        "investigate",
        port,
        "--bench",
        "aa-050h",
        "--out",
        str(tmp_path / "study"),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout)["ended"]
    found = {e["name"]: e for e in ended["effects"]}
    assert set(found) == {"sensor_lag", "amplifier_lag"} and ended["how"] == "settled"
    assert found["sensor_lag"]["parameters"]["tau"]["value"] == pytest.approx(1e-4, rel=0.05)
    assert found["amplifier_lag"]["parameters"]["tau"]["value"] == pytest.approx(5e-5, rel=0.02)
    assert all(e["decided_by"] for e in found.values())
