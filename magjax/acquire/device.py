"""The device side of docs/protocol.md as a state machine without wires: payloads in, payloads out, a clock given from outside.

`response` turns a drive into readings: `response.channels` (name, unit, scale, offset), and
`response.prepare(drive in A, rate, repeats, samples) -> (start, period)`, SI, (time, channels): what is read once, then again and again;
`response.ended(samples)` tells when a run is over.
"""

import json
import secrets

import numpy as np

from ..errors import MagjaxError
from . import protocol as p

DRIVE_SCALE = 5e-5  # A a count: +-1.6 A
TABLE = 65536


class Device:
    """An emulated device. `drive_limit`: A; `first_seq`, `clock_us`, `clock_bits`: where counters start, to see them wrap."""

    def __init__(self, response, *, name="emulated", rate_max=2e5, frame_samples=64, watchdog_s=2.0, drive_limit=1.0, drift_ppm=0.0,
                 first_seq=0, clock_us=0, clock_bits=64, noise=True, seed=0):  # fmt: skip
        self.response, self.name = response, name
        self.rate_max, self.frame_samples, self.watchdog_s, self.drive_limit = rate_max, frame_samples, watchdog_s, drive_limit
        self.first_seq, self.clock_us, self.clock_bits = first_seq, clock_us, clock_bits
        self.speed_up = 1 + 1e-6 * drift_ppm
        self.noise = np.array([c.get("noise", 0.0) / (c["scale"] * p.SI[c["name"]][c["unit"]]) for c in response.channels]) * bool(
            noise
        )
        self.random = np.random.default_rng(seed)
        self.boot(0.0)

    def boot(self, now: float) -> bytes:
        """Start anew: another boot_id, nothing running, the drive at zero. Returns the HELLO."""
        if getattr(self, "running", False):
            self.response.ended(self.samples)
        self.boot_id = secrets.token_hex(4)
        self.table, self.repeats, self.filled = np.zeros(0, "<i2"), 0, 0
        self.running, self.last, self.run, self.prepared = False, None, None, None
        self.frames = self.samples = self.dropped = 0
        self.heard = now
        return self.hello()

    def hello(self) -> bytes:
        """HELLO as it stands now."""
        channels = [{k: c[k] for k in ("name", "unit", "scale", "offset")} for c in self.response.channels]
        last = None if self.last is None else dict(zip(p.LAST, self._last_row(), strict=True))
        return p.hello_packet({
            "protocol": p.VERSION, "device": self.name, "firmware": "magjax emulator 1", "boot_id": self.boot_id, "rate_max_Hz": self.rate_max,
            "frame_samples": self.frame_samples, "clock_bits": self.clock_bits, "watchdog_s": self.watchdog_s, "channels": channels,
            "drive": {"unit": "A", "scale": DRIVE_SCALE, "limit": self.drive_limit, "table": TABLE}, "drive_now": self.drive_now(),
            "running": self.running, "run": self.run, "last": last,
        })  # fmt: skip

    def _last_row(self):
        f = self.last
        return f.reason, f.run, f.last_seq, f.frames, f.samples, f.dropped

    def drive_now(self) -> int:
        """The drive at this moment, counts."""
        if not self.running or len(self.table) == 0 or (self.repeats and self.samples >= self.repeats * len(self.table)):
            return 0
        return int(self.table[self.samples % len(self.table)])

    def receive(self, payload: bytes, now: float) -> list[bytes]:
        """Answers to one payload of the host."""
        self.heard = now
        kind, version = payload[0], payload[1]
        if version != p.VERSION:
            return [p.ack_packet(kind, 1, 0, f"protocol version {version} is not {p.VERSION}")]
        if kind == p.QUERY:
            return [self.hello()]
        if kind == p.ALIVE:
            return []
        if kind == p.STOP:
            return [self.finish(0) if self.running or self.last is None else p.final_packet(self.last)]
        try:
            if kind == p.DRIVE:
                return [self._drive(payload)]
            if kind == p.GENERATE:
                return [self._generate(payload)]
            if kind == p.START:
                return [self._start(payload, now)]
        except (ValueError, MagjaxError) as error:
            return [p.ack_packet(kind, 1, 0, str(error))]
        return [p.ack_packet(kind, 1, 0, f"packet type {kind:#x} is unknown")]

    def _drive(self, payload):
        _, _, start, total, repeats = p.DRIVE_HEAD.unpack_from(payload)
        counts = np.frombuffer(payload, "<i2", offset=p.DRIVE_HEAD.size)
        if self.running:
            raise ValueError("a run is on; STOP first")
        if total > TABLE or start + len(counts) > total:
            raise ValueError(f"a table of {total} samples does not fit; {TABLE} do")
        self._check(counts)
        if start == 0:
            self.table, self.filled = np.zeros(total, "<i2"), 0
        if total != len(self.table) or start > self.filled:
            raise ValueError(f"piece at {start} comes before the one at {self.filled}")
        self.table[start : start + len(counts)] = counts
        self.filled, self.repeats = max(self.filled, start + len(counts)), repeats
        return p.ack_packet(p.DRIVE, 0, start)

    def _generate(self, payload):
        _, _, width, periods, amplitude, offset, factor = p.GENERATE_BODY.unpack_from(payload)
        if self.running:
            raise ValueError("a run is on; STOP first")
        steady = factor == 1.0
        if not 4 <= width <= TABLE or (not steady and width * periods > 4_000_000):
            raise ValueError(f"{width} samples a period do not fit")
        k = np.arange(width if steady else width * periods)
        decay = np.float64(factor) ** (k / width)
        table = np.round(offset + amplitude * decay * np.sin(2 * np.pi * k / width))
        self._check(table)
        self.table, self.filled, self.repeats = table.astype("<i2"), len(table), periods if steady else 1
        return p.ack_packet(p.GENERATE)

    def _check(self, counts):
        if len(counts) and np.abs(counts).max() * DRIVE_SCALE > self.drive_limit * (1 + 1e-9):
            raise ValueError(
                f"the drive reaches {np.abs(counts).max() * DRIVE_SCALE:.4g} A, the device allows {self.drive_limit:g} A"
            )

    def _start(self, payload, now):
        _, _, run, rate, samples = p.START_BODY.unpack_from(payload)
        rate = 1e-3 * rate
        text = json.dumps({"rate_Hz": rate, "boot_id": self.boot_id})
        if run == self.run:  # sent again: the first answer was lost, or late
            return p.ack_packet(p.START, 0, self.first_seq, text)
        if self.running:
            raise ValueError(f"run {self.run} is on; STOP first")
        if not 0 < rate <= self.rate_max:
            raise ValueError(f"a rate of {rate:g} Hz is beyond {self.rate_max:g} Hz")
        if self.filled < len(self.table):
            raise ValueError(f"the table holds {self.filled} of {len(self.table)} samples")
        drive = self.table * DRIVE_SCALE if len(self.table) else np.zeros(16)
        start, period = self.response.prepare(drive, rate, self.repeats, samples)
        self.prepared = self._counts(start), self._counts(period)
        self.run, self.rate, self.wanted, self.running = run, rate, samples, True
        self.frames = self.samples = self.dropped = 0
        self.begin = None
        return p.ack_packet(p.START, 0, self.first_seq, text)

    def _counts(self, values):
        rows = [
            (values[:, k] / p.SI[c["name"]][c["unit"]] - c["offset"]) / c["scale"] for k, c in enumerate(self.response.channels)
        ]
        return np.stack(rows, axis=1)

    def read(self, first: int, count: int) -> np.ndarray:
        """Readings from sample `first` on, counts with noise, (count, channels), i16."""
        start, period = self.prepared
        k = np.arange(first, first + count)
        values = period[(k - len(start)) % len(period)]
        if first < len(start):
            early = k < len(start)
            values[early] = start[k[early]]
        if self.noise.any():
            values = values + self.noise * self.random.standard_normal(values.shape)
        return np.clip(np.round(values), -32768, 32767).astype("<i2")

    def due(self, now: float, most: int, fast: bool) -> list[bytes]:
        """DATA payloads that are due, `most` at a time, and FINAL where the run ends."""
        if not self.running:
            return []
        if self.watchdog_s and now - self.heard > self.watchdog_s:
            return [self.finish(2)]
        self.begin = now if self.begin is None else self.begin
        ready = most * self.frame_samples if fast else int((now - self.begin) * self.rate * self.speed_up) - self.samples
        ready = min(ready, most * self.frame_samples)
        if self.wanted:
            ready = min(ready, self.wanted - self.samples)
        ending = self.wanted and self.samples + ready >= self.wanted
        count = ready if ending else ready - ready % self.frame_samples
        packets = self._packets(count)
        return packets + [self.finish(1)] if ending else packets

    def _packets(self, count):
        if count <= 0:
            return []
        block, width = self.read(self.samples, count), self.frame_samples
        packets = []
        for k in range(0, count, width):
            time_us = self.clock_us + round((self.samples + k) * 1e6 / self.rate)
            packets.append(p.data_packet(self.first_seq + self.frames, time_us % (1 << self.clock_bits), block[k : k + width]))
            self.frames += 1
        self.samples += count
        return packets

    def finish(self, reason: int) -> bytes:
        """End the run, drive to zero; FINAL."""
        if self.running:
            self.response.ended(self.samples)
        self.running = False
        self.last = p.Final(
            reason, self.run or 0, (self.first_seq + self.frames - 1) & 0xFFFFFFFF, self.frames, self.samples, self.dropped
        )
        return p.final_packet(self.last)
