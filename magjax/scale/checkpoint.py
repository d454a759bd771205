"""An append-only file of finished chunks that survives kill -9 at any moment.

Each line is `crc32 json`, written whole and synced before the chunk counts as done. The first line says which job it
is. A torn last line is cut off, a damaged line costs its chunk only. One job at a time may hold the file.
"""

import json
import os
import zlib
from pathlib import Path

from ..errors import ConfigurationError

FORMAT = "magjax checkpoint 1"


def _line(content) -> bytes:
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"%08x " % zlib.crc32(text) + text + b"\n"


def _content(line: bytes):
    """The content of a whole line; None where it is torn or damaged."""
    if len(line) < 10 or not line.endswith(b"\n") or line[8:9] != b" ":
        return None
    text = line[9:-1]
    try:
        return json.loads(text) if int(line[:8], 16) == zlib.crc32(text) else None
    except ValueError:
        return None


class Checkpoint:
    """Finished chunks of a job: `done` maps (chunk id, digest of its item) to the encoded result.

    `header`: what makes the job: its name, digest and versions. Raises `ConfigurationError` where the file belongs to
    another job, is no checkpoint, is held by a running job or cannot be written.
    """

    def __init__(self, path, header: dict):
        self.path, self.header = Path(path), {"format": FORMAT, **header}
        self.done: dict[tuple[str, str], object] = {}
        self.damaged = 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "a+b")
        except OSError as error:
            words = f"the checkpoint cannot be written ({error.strerror}); choose another --checkpoint"
            raise ConfigurationError(f"{path}: {words}") from None
        try:
            self._lock()
            self._read()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()

    def _lock(self):
        try:
            import fcntl
        except ImportError:  # no advisory locks on this system: two jobs on one file are the user's care
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            words = "another job is writing to this checkpoint; wait for it or choose another file"
            raise ConfigurationError(f"{self.path}: {words}") from None

    def _read(self):
        self._file.seek(0)
        first = self._file.readline()
        if not first or (not first.endswith(b"\n") and self._begins_as_header(first)):
            self._file.truncate(0)
            self._append(self.header)
            return
        self._compare(_content(first))
        whole = self._file.tell()
        for line in self._file:
            if not line.endswith(b"\n"):
                self._file.truncate(whole)
                break
            whole += len(line)
            row = _content(line)
            if row is None:
                self.damaged += 1
            else:
                self.done[row["chunk"], row["item"]] = row["result"]

    def _begins_as_header(self, torn: bytes) -> bool:
        """Whether a lone unfinished line is our own header, cut short (nothing is lost with it)."""
        own = _line(self.header)
        return own.startswith(torn) or torn[9:].startswith(b'{"format":"magjax')

    def _compare(self, found):
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            words = "not a checkpoint of magjax (its first line is not one); choose another --checkpoint"
            raise ConfigurationError(f"{self.path}: {words}")
        different = [k for k in self.header if found.get(k) != self.header[k]]
        if different:
            key = different[0]
            raise ConfigurationError(
                f"{self.path}: the checkpoint belongs to another job ({key}: {found.get(key)}, here {self.header[key]}); "
                "choose another --checkpoint or remove the file"
            )

    def _append(self, content):
        try:
            self._file.write(_line(content))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            words = f"the checkpoint cannot be written ({error.strerror}); make room, then resume"
            raise ConfigurationError(f"{self.path}: {words}") from None

    def add(self, chunk: str, item: str, result) -> None:
        """Write a finished chunk; it is on the disk when this returns. `item`: digest; `result`: encoded."""
        self._append({"chunk": chunk, "item": item, "result": result})
        self.done[chunk, item] = result
