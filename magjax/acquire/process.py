"""The recorder's process: an order as one line of JSON on stdin, progress as JSON lines on stdout; and how another process starts it.

    python -m magjax.acquire.process < order.json

It stands alone because a reader beside busy Python loses frames (1,950 of 3,505 at 3 Mbaud in a thread, 16 in a process).
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading

from ..errors import MagjaxError
from ..interrupts import raise_if_seen
from .order import Order
from .recorder import Ended, Recorder


class Teller:
    """JSON lines on stdout that never hold the reader up: a line that does not fit is left out, the last one is waited for."""

    def __init__(self, recorder_stop):
        self.stop = recorder_stop
        os.set_blocking(1, False)

    def __call__(self, content: dict) -> None:
        """One line, if there is room."""
        try:
            os.write(1, json.dumps(content).encode() + b"\n")
        except BlockingIOError:
            return
        except OSError:
            self.stop("the terminal is gone", 6)

    def last(self, content: dict) -> None:
        """The last line."""
        os.set_blocking(1, True)
        try:
            os.write(1, b"\n" + json.dumps(content).encode() + b"\n")
        except OSError:
            return


ENDINGS = {"SIGINT": ("interrupted", 130), "SIGTERM": ("asked to end", 130), "SIGHUP": ("the terminal is gone", 6)}


def main() -> int:
    """Read an order, record it, say how it ended."""
    recorder = None
    asked = []

    def end(reason, status):
        asked[:] = asked or [(reason, status)]
        if recorder is not None:
            recorder.stop = asked[0]

    for name, ending in ENDINGS.items():
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), lambda *_, ending=ending: end(*ending))
    if hasattr(signal, "SIGXFSZ"):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    hold_signals(False)
    order = Order.from_json(sys.stdin.readline())
    teller = Teller(end)
    recorder = Recorder(order, teller)
    recorder.stop = asked[0] if asked else None
    try:
        summary = recorder.run()
    except Ended as error:
        teller.last({"state": "refused", "reason": error.reason, "status": error.status})
        return error.status
    except MagjaxError as error:
        teller.last({"state": "refused", "reason": str(error), "status": error.exit_status})
        return error.exit_status
    except Exception as error:  # a defect: its last word is still one line, and the drive was brought to zero on the way out
        reason = f"the recorder failed ({type(error).__name__}: {error}); {order.path} holds what was acknowledged"
        teller.last({"state": "ended", "reason": reason, "status": 6, "path": order.path})
        return 6
    teller.last({"state": "ended", **summary})
    return summary["status"]


def hold_signals(hold: bool) -> None:
    """Keep SIGINT and SIGTERM waiting (or let them come): a Ctrl-C while the recorder is starting must not be lost."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK if hold else signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))


class Forward:
    """While it lasts, Ctrl-C (or SIGTERM) is passed on to a recorder instead of ending this process at some odd place."""

    def __init__(self, child):
        self.child, self.before, self.count = child, {}, 0

    def __enter__(self):
        if threading.current_thread() is threading.main_thread():
            self.before = {number: signal.signal(number, self.forward) for number in (signal.SIGINT, signal.SIGTERM)}
        hold_signals(False)

    def forward(self, number, _frame):
        """Pass it on; who asks for the fifth time does not want to wait for an order that does not come."""
        self.count += 1
        if self.count > 4:
            raise KeyboardInterrupt
        self.child.send_signal(number)

    def __exit__(self, *_):
        for number, handler in self.before.items():
            signal.signal(number, handler)


def record(order: Order, progress=None) -> dict:
    """Run an order in a recorder process of its own; the last line as a dict with `status` and `reason`.

    `progress(dict)` is called a few times a second. Ctrl-C ends the recording in order and is reported as status 130.
    """
    raise_if_seen()
    command = [sys.executable, "-m", "magjax.acquire.process"]
    hold_signals(True)  # the recorder inherits it, and lets them come once it can answer them
    try:
        child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        )
    except OSError:
        hold_signals(False)
        raise
    last = None
    with child, Forward(child):
        with contextlib.suppress(BrokenPipeError):  # killed at once: told below
            child.stdin.write(order.to_json() + "\n")
            child.stdin.close()
        for line in child.stdout:
            if not line.strip():
                continue
            content = json.loads(line)
            if content["state"] == "recording":
                if progress:
                    progress(content)
            else:
                last = content
    if last is None:
        return {
            "state": "ended",
            "status": 6,
            "reason": f"the recorder died; {order.path} holds what was acknowledged",
            "path": order.path,
        }
    return last


if __name__ == "__main__":
    sys.exit(main())
