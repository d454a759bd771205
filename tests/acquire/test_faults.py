"""Faults between real processes: nothing acknowledged is lost, nothing corrupt is read as good, every loss is counted."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import until, verify

from magjax.acquire.framing import Splitter, encode
from magjax.acquire.link import ask_hello, open_port
from magjax.acquire.log import Log
from magjax.acquire.process import record
from magjax.acquire.protocol import FINAL, QUERY, STOP, bare_packet
from magjax.recording import load_recordings


def events(path, kind):
    return [e for e in Log(path).events if e["event"] == kind]


def drive_at_zero(port, silence=0.0):
    """Is the drive at zero and no run on? First `silence` s for the watchdog, longer each time: a question keeps it quiet."""
    for pause in (silence, 2 * silence, 8 * silence):
        time.sleep(pause)
        device = open_port(port)
        hello = ask_hello(device, 20.0)
        device.close()
        if hello.content["drive_now"] == 0 and not hello.running:
            return True
    return False


def recorder(order, **options):
    """A recorder process, already ordered."""
    place = Path(order.path + ".order")
    place.write_text(order.to_json() + "\n")
    with open(place) as stream:
        return subprocess.Popen([sys.executable, "-m", "magjax.acquire.process"], stdin=stream, stdout=subprocess.PIPE, text=True,
                                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}, **options)  # fmt: skip


def until_recording(child, samples=1):
    """Wait until a recorder has acknowledged so many samples; how many it has."""
    for line in child.stdout:
        if line.strip() and (done := json.loads(line).get("acknowledged", 0)) >= samples:
            return done
    raise AssertionError("the recorder ended before it recorded anything")


def rest(child):
    """The last report of a recorder that is ending; None where there is none."""
    with child:
        lines = [line for line in child.stdout.read().splitlines() if line.endswith("}")]
    return json.loads(lines[-1]) if lines else None


def test_clean_run_over_a_pty_and_tcp(emulate, order):
    for options in (("--fast",), ("--fast", "--tcp", "0")):
        port = emulate(*options)["port"]
        made = order(port)
        made.path = made.path.replace("run.mjlog", f"run{len(options)}.mjlog")
        end = record(made)
        assert end["status"] == 0, end
        assert (end["status"], end["reason"], end["received"], end["lost"]) == (0, "done", 100_000, 0)
        log = verify(made.path)
        assert log.samples == 100_000 and log.end["reason"] == "done" and not log.damage
        assert drive_at_zero(port)


@pytest.mark.parametrize(
    "faults",
    [
        *(pytest.param(one, marks=pytest.mark.long) for one in (("drop=2e-5",), ("flip=2e-5",), ("zeros=200000",))),
        ("merge=0.02", "duplicate=0.05"), ("drop=3e-5", "flip=3e-5", "merge=0.01"),
    ],
)
def test_damage_on_the_line_is_counted_exactly(emulate, order, faults):
    words = [w for f in faults for w in ("--fault", f)]
    port = emulate("--fast", "--seed", "3", *words)["port"]
    made = order(port)
    end = record(made)
    assert end["status"] == 0 and end["tail_known"]
    log = verify(made.path)
    assert end["received"] + end["lost"] == end["sent"] == 100_000
    assert log.samples == end["received"]
    if faults == ("zeros=200000",):
        assert end["lost"] == 0
    else:
        assert 0 < end["lost"] < 30_000 and end["damaged_frames"] > 0
    gaps = sum(e["samples"] for e in events(made.path, "gap"))
    assert 0 <= end["lost"] - gaps <= 3 * 64  # what no gap shows is the tail
    if "duplicate=0.05" in faults:
        assert end["repeats"] > 10


def test_counters_and_clock_wrap(emulate, order):
    port = emulate("--fast", "--fault", "wrap")["port"]
    made = order(port, rate=50e3)
    end = record(made)
    assert (end["status"], end["received"], end["lost"]) == (0, 100_000, 0)
    log = verify(made.path)
    begin, last = log.pieces[0][2], log.pieces[-1][3]
    assert begin < 2**32 < last and last - begin == pytest.approx(2e6, rel=0.01)


def test_a_reset_is_an_event_and_the_run_starts_anew(emulate, order):
    port = emulate("--fast", "--fault", "reset=300")["port"]
    made = order(port)
    end = record(made)
    assert end["status"] == 0 and end["segments"] == 2
    assert len(events(made.path, "reset")) == 1
    log = verify(made.path)
    assert sum(len(p[4]) for p in log.pieces if p[0] == 1) == 100_000
    assert len({e["boot_id"] for e in events(made.path, "start")}) == 2


def test_a_stall_is_told_and_its_losses_counted(emulate, order):
    port = emulate("--fault", "stall=1.5", "--fault", "at=200")["port"]
    made = order(port, samples=150_000, stall_s=0.5)
    end = record(made)
    assert end["status"] == 0 and events(made.path, "stall")
    assert end["received"] + end["lost"] == end["sent"] == 150_000 and end["lost"] > 10_000
    assert end["dropped_by_device"] > 0
    verify(made.path)


def test_a_lost_tail_is_counted(emulate, order):
    # the last 60 of 782 frames fall into a silence: no sequence number shows them, only the device's own count
    port = emulate("--fault", "stall=4", "--fault", "at=720")["port"]
    made = order(port, samples=50_000)
    end = record(made)
    assert end["status"] == 0 and end["received"] + end["lost"] == end["sent"] == 50_000
    in_gaps = sum(e["samples"] for e in events(made.path, "gap"))
    assert end["lost"] - in_gaps > 500
    verify(made.path)


def test_unplugged_and_back_under_another_name(emulate, order, tmp_path):
    port = emulate("--link", str(tmp_path / "ttyEMU"), "--fault", "unplug=0.7")["port"]
    made = order(port, samples=120_000)
    end = record(made)
    assert end["status"] == 0, end
    assert events(made.path, "reconnect")[0]["port"].endswith("ttyEMU1") and events(made.path, "disconnect")
    assert end["received"] + end["lost"] == end["sent"] == 120_000 and end["lost"] > 0 and end["segments"] == 1
    verify(made.path)


def test_unplugged_for_good_ends_early_with_an_intact_file(emulate, order, tmp_path):
    device = emulate("--link", str(tmp_path / "ttyEMU"))
    child = recorder(order(device["port"], samples=0, give_up_s=1.0))
    until_recording(child)
    device["process"].kill()
    last = rest(child)
    assert child.returncode == last["status"] == 6 and "unplugged" in last["reason"] and "watchdog" in last["drive_at_zero"]
    log = verify(tmp_path / "run.mjlog")
    assert log.end["reason"] == last["reason"] and log.samples == last["acknowledged"] > 0


def test_a_stopped_reader_loses_and_counts(emulate, order):
    port = emulate("--baud", "2000000", "--watchdog", "5")["port"]
    made = order(port, rate=40e3, samples=120_000)
    child = recorder(made)
    until_recording(child)
    child.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    child.send_signal(signal.SIGCONT)
    end = rest(child)
    assert end["status"] == 0 and end["received"] + end["lost"] == end["sent"] == 120_000
    assert end["lost"] > 0 and end["dropped_by_device"] > 0
    verify(made.path)


def test_ctrl_c_stops_in_order(emulate, order):
    port = emulate()["port"]
    made = order(port, samples=0)
    child = recorder(made)
    until_recording(child)
    child.send_signal(signal.SIGINT)
    end = rest(child)
    assert child.returncode == 130 and end["reason"] == "interrupted" and end["drive_at_zero"] == "confirmed"
    assert end["received"] + end["lost"] == end["sent"]
    assert verify(made.path).samples == end["acknowledged"] > 0
    assert drive_at_zero(port)


@pytest.mark.parametrize(
    ("seconds", "number"),
    [
        pytest.param(s, n, marks=[] if s in (0.3, None) or (s, n) == (0.8, signal.SIGINT) else pytest.mark.long)
        for s in (0.3, 0.8, 1.5, None)
        for n in (signal.SIGINT, signal.SIGTERM)
    ],
)
def test_ctrl_c_at_odd_moments(emulate, tmp_path, seconds, number):
    """To the command line alone: while it imports, while the recorder starts, while it records."""
    device = emulate()
    path = tmp_path / "run.mjlog"
    command = [sys.executable, "-m", "magjax", "record", device["port"], "--out", str(path), "--periods", "0"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if seconds is None:
        until(lambda: path.exists() and path.stat().st_size > 20_000)
    else:
        time.sleep(seconds)
    if number == signal.SIGTERM and not path.exists():
        child.kill()  # before it records there is nothing to end in order
        child.communicate()
        return
    child.send_signal(number)
    out, err = child.communicate(timeout=60)
    # a Ctrl-C that lands in an import's exec of a string ends the process by the signal itself, whoever answers it: a shell says 130, too
    ended = (130,) if seconds is None else (130, -signal.SIGINT)
    assert child.returncode in ended and "Traceback" not in out + err and "Exception" not in err, err
    assert seconds is not None or ("interrupted" in err or "asked to end" in err) and "drive at zero: confirmed" in err
    assert drive_at_zero(device["port"])
    if path.exists():
        log = Log(path)
        assert log.end["drive_at_zero"] == "confirmed" and not log.damage


def test_the_duration_limit_ends_it(emulate, order):
    port = emulate()["port"]
    end = record(order(port, samples=0, max_s=0.6))
    assert (end["status"], end["drive_at_zero"]) == (0, "confirmed") and "duration limit" in end["reason"]
    assert drive_at_zero(port)


def test_a_full_disk_ends_the_recording_with_the_drive_at_zero(emulate, order):
    port = emulate("--fast")["port"]
    made = order(port, samples=5_000_000)

    def limited():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    child = recorder(made, preexec_fn=limited)
    end = rest(child)
    assert child.returncode == 6 and "run.mjlog" in end["reason"] and end["drive_at_zero"] == "confirmed"
    log = verify(made.path)
    assert end["received"] + end["lost"] == end["sent"] > end["received"] == log.samples
    assert log.samples == end["acknowledged"] > 1_000 and not log.damage  # a chunk that no longer fits is lost as a whole
    assert drive_at_zero(port)


def kill_at(order, seconds, recording=True):
    """Kill -9 so long after the start (of the recording, or of the process); how many samples were acknowledged by then."""
    child = recorder(order)
    acknowledged = until_recording(child) if recording else 0
    time.sleep(seconds)
    child.kill()
    last = rest(child)
    return last["acknowledged"] if last else acknowledged


def killed_at_random(emulate, order, count, durable):
    """kill -9 at random moments: (logs that lack acknowledged samples or are torn in more than one place, logs that hold some).

    The device's watchdog must have ended the last run too.
    """
    port = emulate("--watchdog", "1")["port"]  # the next recorder ends a run that is still on
    random = np.random.default_rng(count)
    kept, wrong = 0, []
    for k in range(count):
        made = order(port, samples=0, durable=durable)
        made.path = made.path.replace("run.mjlog", f"run{k}.mjlog")
        acknowledged = kill_at(made, random.uniform(0.0, 0.7), recording=k % 4 > 0)
        if os.path.exists(made.path):
            log = verify(made.path)
            if log.samples < acknowledged or len(log.damage) > 1 or log.end is not None:
                wrong.append((k, log.samples, acknowledged, log.damage))
            kept += acknowledged > 0
    assert drive_at_zero(port, 1.2)
    return wrong, kept


def test_killed_at_random_moments(emulate, order):
    wrong, kept = killed_at_random(emulate, order, 4, False)
    assert wrong == [] and kept > 2


@pytest.mark.long
@pytest.mark.parametrize("durable", [False, True])
def test_killed_at_a_hundred_random_moments(emulate, order, durable):
    wrong, kept = killed_at_random(emulate, order, 100, durable)
    assert wrong == [] and kept > 50


def test_a_killed_recording_is_resumed(emulate, order, tmp_path):
    port = emulate()["port"]
    made = order(port, samples=0)
    assert kill_at(made, 0.3) > 0
    with open(made.path, "ab") as stream:
        stream.write(b"MJL1 torn")
    command = [
        sys.executable,
        "-m",
        "magjax",
        "record",
        port,
        "--out",
        made.path,
        "--resume",
        "--frequency",
        "100",
        "--samples",
        "100",
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    log = Log(made.path)
    assert not log.damage and log.end["reason"] == "done" and [e for e in log.events if e["event"] == "resume"]
    recordings = load_recordings([made.path], "aa-050h")
    assert len(recordings) == 2 and recordings[1].frequency() == pytest.approx(100)


def test_stop_is_answered_twice_alike(emulate):
    port = open_port(emulate("--fast")["port"])
    ask_hello(port, 20.0)
    port.write(encode(bare_packet(QUERY)) + encode(bare_packet(STOP)) * 2)  # as a slow start does: another HELLO on its way
    splitter, finals = Splitter(), []
    until(lambda: finals.extend(x for x in splitter.feed(port.read(200)) if x[0] == FINAL) or len(finals) >= 2)
    first, second = finals
    assert first == second
    port.close()
