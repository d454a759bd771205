"""Real processes for the acquisition tests: an emulated device on a pseudo-terminal or TCP port, and the recorder."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from magjax.acquire.log import Log
from magjax.acquire.order import Order

SCALE = 5e-5  # A a count, of drive and shunt alike
RAMP = ((np.arange(20011) * 37) % 19997 - 9998).astype(int)  # no stretch of it repeats


@pytest.fixture
def emulate():
    """Start an emulator: emulate("--fault", "drop=1e-4") -> its first line as a dict; all are ended after the test."""
    started = []

    def start(*options, bench="plain"):
        command = [
            sys.executable,
            "-m",
            "magjax",
            "emulate",
            "--json",
            "--bench",
            bench,
            *(["--exact"] if bench == "plain" else []),
            *([] if "--watchdog" in options else ["--watchdog", "20"]),  # a loaded machine may hold the recorder up
            *options,
        ]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        )
        started.append(process)
        line = process.stdout.readline()
        assert line, process.stderr.read()
        return {**json.loads(line), "process": process}

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


@pytest.fixture
def order(tmp_path):
    """An order that plays the ramp: order(port, rate=..., samples=...)."""

    def make(port, **changes):
        drive = {"kind": "table", "values": (RAMP * SCALE).tolist(), "repeats": 0}
        given = {
            "rate": 50e3,
            "samples": 100_000,
            "drive": drive,
            "boot_wait_s": 30.0,
            "start_wait_s": 30.0,
            "stop_wait_s": 30.0,
            "give_up_s": 30.0,
            "header": {"bench": "plain"},
        }
        return Order(port, str(tmp_path / "run.mjlog"), **{**given, **changes})

    return make


def until(what, seconds: float = 30.0):
    """Ask again until `what()` is true; its value. Fails after so many seconds: a loaded machine is slow, not wrong."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.02)
    return found


def verify(path) -> Log:
    """Every sample in a log is the one that the device measured at that number; returns the log."""
    log = Log(path)
    for _, first, _, _, counts in log.pieces:
        expected = RAMP[(first + np.arange(len(counts))) % len(RAMP)]
        assert np.array_equal(counts[:, 0], expected)
        assert np.abs(counts[:, 1] - expected * SCALE * 20 * 655.36).max() <= 0.501
    return log
