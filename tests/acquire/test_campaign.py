"""A campaign over a study file: every kind of drive, checks, repeats, what is there is kept; and refusals before anything moves."""

import json

import numpy as np
import pytest

from magjax.acquire import protocol as p
from magjax.acquire.campaign import SETTINGS, Campaign, entries, read_plan
from magjax.acquire.device import Device
from magjax.acquire.log import Log
from magjax.acquire.response import PlainResponse
from magjax.bench import load_bench
from magjax.cli import main
from magjax.errors import ConfigurationError
from magjax.recording import load_recordings

STUDY = """
samples = 200
periods = 4
settle = 2
[[drives]]
kind = "sine"
frequency = [20, 100]
amplitude = 0.5
offset = 0.1
[[drives]]
kind = "multisine"
frequency = [20, 60]
amplitude = 0.4
[[drives]]
kind = "minor_loops"
carrier = 100
modulation = 10
amplitude = 0.5
[[drives]]
kind = "decaying"
frequency = 50
amplitude = 0.8
[[drives]]
kind = "reversal_curves"
low = -0.5
high = 0.5
count = 4
rate = 20
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def test_every_kind_is_recorded_once(emulate, study, tmp_path, capsys):
    port = emulate("--fast")["port"]
    assert main(["record", port, "--plan", str(study), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "6 of 6" in capsys.readouterr().out
    rows = json.loads((tmp_path / "out" / "campaign.json").read_text())["recordings"]
    assert [r["tries"] for r in rows] == [1] * 6
    frequencies = [load_recordings([r["file"]], "aa-050h")[0].frequency() for r in rows[:4]]
    assert frequencies == pytest.approx([20, 100, 20, 10], rel=1e-5)
    assert (tmp_path / "out" / "000_sine_20Hz_0.5A.nc").exists()
    assert all([e for e in Log(r["file"]).events if e["event"] == "demagnetized"] for r in rows)
    assert main(["record", port, "--plan", str(study), "--out", str(tmp_path / "out"), "--json"]) == 0
    assert [r["tries"] for r in json.loads(capsys.readouterr().out)["recordings"]] == [0] * 6


def test_a_bad_recording_is_repeated(emulate, study, tmp_path):
    # a reset within the first recording leaves two segments: not fit to use
    port = emulate("--fault", "reset=80")["port"]
    said = []
    made = Campaign(port, load_bench("aa-050h"), tmp_path, 0.9, {**SETTINGS, **read_plan(study).settings}, {}, say=said.append)
    (row,) = made.run(entries(read_plan(study))[1:2])
    assert row["status"] == 0 and row["tries"] == 2 and "reset" in " ".join(said)
    assert len(list(tmp_path.glob("*.mjlog.bad0"))) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("amplitude = 0.8", "amplitude = 1.8"), "limit is 0.9 A"),
        (("samples = 200", "sample = 200"), "sample is unknown"),
        (("samples = 200", 'samples = "many"'), "write it like 500"),
        (('kind = "decaying"', 'kind = "decayed"'), "is unknown; known are"),
        (("count = 4", "counts = 4"), "counts is unknown for a reversal_curves"),
        (("count = 4", ""), "needs count"),
        (("frequency = [20, 100]", "frequency = [20, 9000]"), "samples a period"),
        (("[[drives]]", "[[drive"), "not valid TOML"),
        (("frequency = [20, 100]", 'frequency = "fast"'), "frequency = 'fast' of a sine; give a number above zero"),
        (("frequency = [20, 100]", "frequency = [20, nan]"), "give a number above zero, or a list"),
        (("frequency = [20, 100]", "frequency = []"), "give a number above zero, or a list"),
        (("amplitude = 0.5\noffset", "amplitude = -0.5\noffset"), "amplitude = -0.5 of a sine"),
        (("offset = 0.1", "offset = true"), "offset = True of a sine; give a number"),
        (("amplitude = 0.4", "amplitude = [0.4, 0.5]"), "amplitude = [0.4, 0.5] of a multisine; give a number above zero"),
        (("modulation = 10", "modulation = 0"), "modulation = 0 of a minor_loops"),
        (("frequency = 50", "frequency = [50, 60]"), "of a decaying; give a number above zero"),
        (("samples = 200", "drives = 3"), "not valid TOML"),
    ],
)
def test_a_bad_plan_is_refused_in_one_line(study, tmp_path, capsys, change, words):
    study.write_text(STUDY.replace(*change))
    assert main(["record", "/dev/ttyNONE", "--plan", str(study), "--out", str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert words in text and text.count("\n") == 1


@pytest.mark.parametrize("text", ["drives = 3", "drives = [1, 2]", '[drives]\nkind = "sine"', ""])
def test_a_plan_without_a_list_of_drives(tmp_path, text):
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(ConfigurationError, match="double brackets"):
        read_plan(tmp_path / "p.toml")
    (tmp_path / "p.toml").write_bytes(b"# \xe9")
    with pytest.raises(ConfigurationError, match="not valid TOML"):
        read_plan(tmp_path / "p.toml")


def test_a_changed_plan_is_recorded_anew(emulate, study, tmp_path):
    """Same name, another drive: what is there is put aside, not taken for it."""
    port = emulate("--fast")["port"]
    made = Campaign(
        port, load_bench("aa-050h"), tmp_path, 0.9, {**SETTINGS, **read_plan(study).settings}, {}, say=lambda text: None
    )
    row = lambda: made.run(entries(read_plan(study))[2:3])[0]
    assert (row()["tries"], row()["tries"]) == (1, 0)
    study.write_text(STUDY.replace("amplitude = 0.4", "amplitude = 0.41"))
    assert (row()["tries"], row()["tries"]) == (1, 0)
    assert len(list(tmp_path.glob("*.mjlog.other0"))) == 1 and not list(tmp_path.glob("*.bad*"))


def test_what_the_device_cannot_do_is_refused_before_anything_moves(emulate, study, tmp_path, capsys):
    study.write_text(STUDY.replace("count = 4", "count = 400").replace("rate = 20", "rate = 0.01"))
    assert main(["record", emulate("--fast")["port"], "--plan", str(study), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "the device holds 65536" in capsys.readouterr().err and not list((tmp_path / "out").glob("*.mjlog"))


@pytest.mark.parametrize("command", ["record", "investigate"])
@pytest.mark.parametrize("limit", ["nan", "0", "-1", "inf"])
def test_a_limit_that_is_none_is_refused(study, tmp_path, capsys, command, limit):
    assert main([command, "/dev/ttyNONE", "--plan", str(study), "--out", str(tmp_path / "out"), "--limit", limit]) == 2
    assert f"--limit = {limit}" in capsys.readouterr().err


def test_a_plan_at_a_missing_port_is_status_5(study, tmp_path, capsys):
    assert main(["record", "/dev/ttyNONE", "--plan", str(study), "--out", str(tmp_path / "out")]) == 5
    assert "no such port" in capsys.readouterr().err
    with pytest.raises(ConfigurationError, match="no.such"):
        read_plan(tmp_path / "no.such")


def test_the_device_starts_a_run_once_and_keeps_to_its_limit():
    device = Device(PlainResponse(exact=True), drive_limit=0.5)
    ack = p.read_ack(device.receive(p.generate_packet(100, 0, 12000, 0), 0.0)[0])
    assert ack.status and "allows 0.5 A" in ack.text
    assert p.read_ack(device.receive(p.generate_packet(100, 0, 9000, 0), 0.0)[0]).status == 0
    start = p.start_packet(77, 1e4, 1000)
    first = device.receive(start, 0.0)
    packets = device.due(0.0, 100, True)
    assert packets[-1][0] == p.FINAL and p.read_final(packets[-1]).samples == 1000 and device.drive_now() == 0
    assert device.receive(start, 0.0) == first and device.due(0.0, 100, True) == []
    device.receive(p.start_packet(78, 1e4, 0), 0.0)
    device.due(0.1, 1, True)
    assert device.running and p.read_final(device.due(10.0, 1, True)[0]).reason == 2 and device.drive_now() == 0
    assert np.array_equal(device.read(0, 4)[:, 0], device.table[:4])
