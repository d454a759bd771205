"""`python -m tests.studies.silence [-- COMMAND ...]`: on a terminal, how long until a command says something, and its longest silence.

Each command runs on a pseudo-terminal; the first byte and the longest gap between bytes are timed, in s.
"""

import os
import pty
import select
import subprocess
import sys
import time


def silence(command, cwd=None, timeout: float = 600.0):
    """(s to the first byte, longest gap in s, exit status, text) of a command on a terminal of 100 columns."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": "100", "TERM": "xterm-256color"}
    begin = last = time.monotonic()
    child = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, cwd=cwd, env=environment, close_fds=True)
    os.close(theirs)
    first, gap, text = None, 0.0, b""
    while time.monotonic() - begin < timeout:
        if select.select([ours], [], [], 0.05)[0]:
            try:
                part = os.read(ours, 65536)
            except OSError:  # the child has closed its end
                break
            if not part:
                break
            now = time.monotonic()
            first = now - begin if first is None else first
            gap, last, text = max(gap, now - last), now, text + part
        elif child.poll() is not None:
            break
    child.kill() if child.poll() is None else None
    status = child.wait()
    os.close(ours)
    return (
        first if first is not None else time.monotonic() - begin,
        max(gap, time.monotonic() - last),
        status,
        text.decode(errors="replace"),
    )


COMMANDS = (
    "--help", "fit --help", "simulate --out s.nc", "sweep --frequencies 10,100 --amplitudes 0.3,0.6 --out w.nc", "control design --u-bar 3.25",
    "control bounds", "control simulate --out t.csv", "ports",
)  # fmt: skip

if __name__ == "__main__":
    import tempfile

    chosen = [" ".join(sys.argv[2:])] if len(sys.argv) > 2 else COMMANDS
    with tempfile.TemporaryDirectory() as folder:
        for words in chosen:
            first, gap, status, _ = silence(
                [sys.executable, "-m", "magjax", *words.split()], cwd=folder if len(sys.argv) < 3 else None
            )
            print(f"{words:70s} first {first:5.2f} s, longest silence {gap:5.2f} s, status {status}")
