"""The log (.mjlog): append-only chunks, each with magic, kind, index, length and CRC-32, so that any damage costs only what it hits.

    chunk   = "MJL1" kind u8 0 u8 0 u16 index u32 length u32 crc u32 payload      (CRC-32 of all but itself)
    HEADER  JSON: provenance, channels with calibration;  DATA: samples;  EVENT: JSON;  END: JSON with the counts

Every append is one unbuffered write, so a killed process loses nothing that was acknowledged; `durable` adds an fsync in
a thread of its own, for power cuts. A write that falls short (full disk) is cut back to the last whole chunk.
"""

import json
import os
import shutil
import struct
import threading
import time
import zlib
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError, MagjaxError, RecordingError

MAGIC = b"MJL1"
HEAD = struct.Struct("<4sBBHIII")
BODY = struct.Struct("<IQQQIHH")  # segment, first sample, time of first and of last sample in us, samples, channels, type
HEADER, DATA, EVENT, END = 1, 2, 3, 4
TYPES = ("<i2", "<f8")
LONGEST = 1 << 26


class DiskFull(MagjaxError):
    """The log cannot grow: what was acknowledged is safe, the recording ends (exit status 6)."""

    exit_status = 6


class LogWriter:
    """Appends chunks to a log; `written` and `safe` are bytes handed to the system and bytes acknowledged."""

    def __init__(self, path, header: dict | None, durable: bool = False):
        """`header` None resumes a log that exists: a torn tail is cut off first."""
        self.path = Path(path)
        flags = os.O_WRONLY | os.O_APPEND | (0 if header is None else os.O_CREAT | os.O_EXCL)
        try:
            self.written, self._index = (0, 0) if header is not None else _whole_length(self.path)
            self._descriptor = os.open(self.path, flags, 0o644)
            if header is None:
                os.ftruncate(self._descriptor, self.written)
        except FileExistsError:
            raise ConfigurationError(f"{path}: exists already; choose another name or add --resume") from None
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be written ({error.strerror}); choose another place") from None
        self._synced = 0
        self._durable = durable
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._sync, daemon=True) if durable else None
        if self._thread:
            self._thread.start()
        if header is not None:
            self._append(HEADER, json.dumps(header).encode())

    @property
    def safe(self) -> int:
        """Bytes that survive: of a kill of this process, or of a power cut where `durable`."""
        return self._synced if self._durable else self.written

    def data(self, segment: int, first: int, times_us: tuple[int, int], counts) -> None:
        """Samples (samples, channels) of a segment from sample number `first` on."""
        kind = 1 if counts.dtype == np.float64 else 0
        body = BODY.pack(segment, first, times_us[0], times_us[1], len(counts), counts.shape[1], kind)
        self._append(DATA, body + np.ascontiguousarray(counts, TYPES[kind]).tobytes())

    def event(self, kind: str, **details) -> None:
        """Something that happened, with the host's time."""
        self._append(EVENT, json.dumps({"event": kind, "host_time": time.time(), **details}).encode())

    def end(self, summary: dict) -> None:
        """The last word: counts and why it ended."""
        self._append(END, json.dumps(summary).encode())

    def _append(self, kind, payload):
        head = HEAD.pack(MAGIC, kind, 0, 0, self._index, len(payload), 0)[:-4]
        chunk = head + zlib.crc32(payload, zlib.crc32(head)).to_bytes(4, "little") + payload
        try:
            count = os.write(self._descriptor, chunk)
        except OSError as error:
            self._cut_back()
            raise DiskFull(f"{self.path}: {error.strerror}; everything up to {self.written} bytes is kept") from None
        if count < len(chunk):
            self._cut_back()
            raise DiskFull(f"{self.path}: the disk is full; everything up to {self.written} bytes is kept")
        self.written += len(chunk)
        self._index += 1
        self._wake.set()

    def _cut_back(self):
        try:
            os.ftruncate(self._descriptor, self.written)
        except OSError:
            pass  # the torn chunk stays; its CRC keeps it from being read

    def _sync(self):
        while not self._closing:
            self._wake.wait()
            self._wake.clear()
            goal = self.written
            try:
                os.fsync(self._descriptor)
            except OSError:
                continue  # not acknowledged then; the next write tells the reason
            self._synced = goal

    def close(self) -> None:
        """Flush to disk and close."""
        self._closing = True
        self._wake.set()
        if self._thread:
            self._thread.join()
        try:
            os.fsync(self._descriptor)
            self._synced = self.written
        except OSError:
            pass  # a pipe or a full disk: nothing more can be done for it
        os.close(self._descriptor)


def free_room(path) -> int:
    """Bytes free where a file lies; 0 where that cannot be told (its folder is gone)."""
    try:
        return shutil.disk_usage(os.path.dirname(os.path.abspath(path))).free
    except OSError:
        return 0


def chunks(content: bytes):
    """(offset, kind, index, payload) of every whole chunk; kind 0 with an empty payload marks bytes that cannot be read.

    Behind damage, reading goes on at the next magic whose chunk is whole.
    """
    at, size = 0, len(content)
    bad = None
    while at < size:
        found = _chunk_at(content, at)
        if found is None:
            bad = at if bad is None else bad
            at = content.find(MAGIC, at + 1)
            if at < 0:
                break
            continue
        if bad is not None:
            yield bad, 0, at - bad, b""
            bad = None
        kind, index, payload = found
        yield at, kind, index, payload
        at += HEAD.size + len(payload)
    if bad is not None:
        yield bad, 0, size - bad, b""


def _chunk_at(content, at):
    if at + HEAD.size > len(content) or content[at : at + 4] != MAGIC:
        return None
    _, kind, _, _, index, length, crc = HEAD.unpack_from(content, at)
    begin = at + HEAD.size
    if length > LONGEST or begin + length > len(content):
        return None
    payload = content[begin : begin + length]
    return (kind, index, payload) if zlib.crc32(payload, zlib.crc32(content[at : begin - 4])) == crc else None


def _whole_length(path):
    """Length up to the end of the last whole chunk, and the next index."""
    length = index = 0
    content = path.read_bytes()
    for at, kind, number, payload in chunks(content):
        if kind:
            length, index = at + HEAD.size + len(payload), number + 1
    if not length:
        raise RecordingError(f"{path}: no chunk of a log in it; --resume needs a log that magjax record began")
    return length, index


class Log:
    """A log as read: `header`, `events`, `end` (None where it stops without one), `damage` [(offset, bytes)], `pieces`."""

    def __init__(self, path):
        self.path = Path(path)
        self.header, self.events, self.end, self.damage, self.pieces = None, [], None, [], []
        seen = set()
        for at, kind, index, payload in chunks(self.path.read_bytes()):
            if kind == 0:
                self.damage.append((at, index))
                continue
            if index in seen:
                continue
            seen.add(index)
            self._take(kind, payload)
        self.missing = (max(seen) + 1 - len(seen)) if seen else 0
        if self.header is None and (self.pieces or self.events or not seen):
            raise RecordingError(f"{self.path}: its header cannot be read, so its channels are unknown; this is no usable log")

    def _take(self, kind, payload):
        if kind == HEADER:
            self.header = json.loads(payload)
        elif kind == EVENT:
            self.events.append(json.loads(payload))
            if self.events[-1]["event"] == "resume":
                self.end = None
        elif kind == END:
            self.end = json.loads(payload)
        elif kind == DATA:
            segment, first, begin, last, count, channels, code = BODY.unpack_from(payload)
            counts = np.frombuffer(payload, TYPES[code], offset=BODY.size).reshape(count, channels)
            self.pieces.append((segment, first, begin, last, counts))

    @property
    def samples(self) -> int:
        """Samples that can be read."""
        return sum(len(p[4]) for p in self.pieces)

    def started(self, segment: int) -> dict:
        """The start event of a segment: rate_Hz, settle_samples, frequency_Hz and what else was known; where it is
        damaged, the counts at its end, which repeat the most of it."""
        found = [e for kind in ("start", "counts") for e in self.events if e["event"] == kind and e.get("segment") == segment]
        return found[0] if found else {}

    def segment(self, number: int):
        """(sample numbers, device time in us of sample 0, rate in Hz, values (samples, channels)) of one segment."""
        parts = sorted((p for p in self.pieces if p[0] == number), key=lambda p: p[1])
        index = np.concatenate([p[1] + np.arange(len(p[4])) for p in parts])
        values = np.concatenate([p[4] for p in parts])
        (_, first, begin, last, counts), (_, late, later, *_) = parts[0], parts[-1]
        rate = self.started(number).get("rate_Hz")
        if not rate:  # a text device states none: from its clock, begin of piece to begin of piece
            rate = 1e6 * (late - first) / (later - begin) if later > begin else 1e6 * max(len(counts) - 1, 1) / max(last - begin, 1)
        return index, begin - 1e6 * first / rate, rate, values


def read_log(path) -> list[tuple[dict, dict]]:
    """Every segment of a log with samples: (columns by name with unit, SI; metadata). Time runs on the device's clock.

    Lost samples are left out, so that the time shows the gap; what came before the steady state is left out too.
    Raises `RecordingError` where nothing can be read.
    """
    from .order import commanded
    from .protocol import Channel

    log = Log(path)
    channels = [Channel(c["name"], c["unit"], c["scale"], c.get("offset", 0.0)) for c in (log.header or {}).get("channels", [])]
    found = []
    for number in sorted({p[0] for p in log.pieces}):
        start = log.started(number)
        index, _, rate, values = log.segment(number)
        keep = index >= start.get("settle_samples", 0)
        if not keep.any():
            continue
        index, values = index[keep], values[keep]
        table = {"time_s": (index - index[0]) / rate}
        table |= {c.column: c.to_si(values[:, k]) for k, c in enumerate(channels)}
        if "command" in start:
            table["command_A"] = commanded(start["command"], index)
            if not {"current_A", "field_A_per_m"} & set(table):
                table["current_A"] = table["command_A"]
        found.append((table, _metadata(log, number, start, index)))
    if not found:
        raise RecordingError(f"{path}: the log holds no samples; record again")
    return found


def _metadata(log, number, start, index) -> dict:
    flat = {k: v for k, v in log.header.items() if isinstance(v, (str, int, float)) and not isinstance(v, bool)}
    flat["calibration"] = json.dumps(log.header.get("channels", []))
    flat |= {k: v for k, v in start.items() if k in ("frequency_Hz", "rate_Hz", "run", "drive", "boot_id") and v is not None}
    flat["current"] = "measured" if any(c["name"] == "current" for c in log.header.get("channels", [])) else "command"
    flat["segment"] = number
    flat["lost_samples"] = int(index[-1] - index[0] + 1 - len(index))
    flat["ended"] = (log.end or {}).get("reason", "without an end: the recorder was killed or the tail is damaged")
    if not start:
        flat["start"] = "damaged: the rate is from the device's clock, and the transient is not cut off"
    if log.damage:
        flat["damaged_bytes"] = int(sum(n for _, n in log.damage))
    return flat
