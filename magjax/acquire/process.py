"""The recorder's process: an order as one line of JSON on stdin, progress as JSON lines on stdout; and how another process starts it.

    python -m magjax.acquire.process < order.json

It stands alone because a reader beside busy Python loses frames (1,950 of 3,505 at 3 Mbaud in a thread, 16 in a process).
"""

import json
import os
import signal
import subprocess
import sys

from ..errors import MagjaxError
from .order import Order
from .recorder import Recorder


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


def main() -> int:
    """Read an order, record it, say how it ended."""
    order = Order.from_json(sys.stdin.readline())
    recorder = None

    def end(reason, status):
        if recorder is not None:
            recorder.stop = (reason, status)

    teller = Teller(end)
    recorder = Recorder(order, teller)
    signal.signal(signal.SIGINT, lambda *_: end("interrupted", 130))
    signal.signal(signal.SIGTERM, lambda *_: end("asked to end", 130))
    if hasattr(signal, "SIGXFSZ"):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        summary = recorder.run()
    except MagjaxError as error:
        teller.last({"state": "refused", "reason": str(error), "status": error.exit_status})
        return error.exit_status
    teller.last({"state": "ended", **summary})
    return summary["status"]


def record(order: Order, progress=None) -> dict:
    """Run an order in a recorder process of its own; the last line as a dict with `status` and `reason`.

    `progress(dict)` is called a few times a second. Ctrl-C ends the recording in order and is reported as status 130.
    """
    command = [sys.executable, "-m", "magjax.acquire.process"]
    child = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    )
    last = None
    with child:
        child.stdin.write(order.to_json() + "\n")
        child.stdin.close()
        while True:
            try:
                line = child.stdout.readline()
            except KeyboardInterrupt:
                child.send_signal(signal.SIGINT)
                continue
            if not line:
                break
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
