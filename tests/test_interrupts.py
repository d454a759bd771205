"""A Ctrl-C that somebody's import swallows still ends the command."""

import os
import signal
import time

import pytest

from magjax.cli import COMMANDS, main
from magjax.interrupts import raise_if_seen, watched


@pytest.fixture(autouse=True)
def interruptible():
    """Processes that run tests side by side ignore the signal; here it is as at a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def swallowed():
    """An interrupt as a careless import would take it."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)
        return False
    except KeyboardInterrupt:
        return True


def test_a_swallowed_interrupt_is_remembered_until_the_next_command():
    before = signal.getsignal(signal.SIGINT)
    with watched():
        raise_if_seen()
        assert swallowed()
        with pytest.raises(KeyboardInterrupt):
            raise_if_seen()
    assert signal.getsignal(signal.SIGINT) is before
    with watched():
        raise_if_seen()


def test_a_recording_does_not_begin_after_it(monkeypatch, capsys):
    import types

    import magjax.acquire.process as process

    started = []
    monkeypatch.setattr(process.subprocess, "Popen", lambda *a, **k: started.append(a))

    def run(name, arguments):
        assert swallowed()
        process.record(None)

    monkeypatch.setitem(COMMANDS, "record", ("tests.careless", ""))
    monkeypatch.setitem(__import__("sys").modules, "tests.careless", types.SimpleNamespace(run=run))
    assert main(["record", "--quiet"]) == 130
    assert not started and "interrupted" in capsys.readouterr().err
