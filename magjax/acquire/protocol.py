"""Packets of the acquisition protocol, version 1, as docs/protocol.md states them; little endian throughout.

Every payload begins with type (u8) and version (u8). The device keeps the clock: a sample's time is the device's.
"""

import dataclasses
import json
import struct

import numpy as np

from ..errors import DeviceError

VERSION = 1
QUERY, DRIVE, GENERATE, START, STOP, ALIVE = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
HELLO, ACK, DATA, FINAL, NOTE = 0x81, 0x82, 0x83, 0x84, 0x85
NAMES = {
    QUERY: "QUERY", DRIVE: "DRIVE", GENERATE: "GENERATE", START: "START", STOP: "STOP", ALIVE: "ALIVE",
    HELLO: "HELLO", ACK: "ACK", DATA: "DATA", FINAL: "FINAL", NOTE: "NOTE",
}  # fmt: skip
DRIVE_HEAD = struct.Struct("<BBIII")  # type, version, start, total, repeats; then i16 counts
GENERATE_BODY = struct.Struct("<BBIIhhf")  # samples a period, periods, amplitude, offset, factor a period
START_BODY = struct.Struct("<BBIIQ")  # run, rate in mHz, samples (0: until STOP)
ACK_BODY = struct.Struct("<BBBBI")  # command, status, value; then text
DATA_HEAD = struct.Struct("<BBHIQ")  # samples, sequence number, device time of the first sample in us; then i16 counts
FINAL_BODY = struct.Struct("<BBBIIQQI")  # reason, run, last sequence number, frames, samples, frames the device dropped
SHORTEST = {ACK: ACK_BODY.size, DATA: DATA_HEAD.size, FINAL: FINAL_BODY.size}  # bytes of a payload
DRIVE_CHUNK = 100  # counts a DRIVE packet: fits a small microcontroller's buffer
REASONS = {0: "stopped by the host", 1: "all samples sent", 2: "watchdog: the host was silent", 3: "device limit"}

LAST = ("reason", "run", "last_seq", "frames", "samples", "dropped")  # of HELLO, as in FINAL

SI = {
    "current": {"A": 1.0, "mA": 1e-3},
    "field": {"A/m": 1.0, "kA/m": 1e3},
    "displacement": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "flux_density": {"T": 1.0, "mT": 1e-3},
    "magnetization": {"A/m": 1.0, "kA/m": 1e3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "temperature": {"degC": 1.0},
}
COLUMNS = {
    "current": "current_A", "field": "field_A_per_m", "displacement": "displacement_m", "flux_density": "flux_density_T",
    "magnetization": "magnetization_A_per_m", "voltage": "voltage_V", "temperature": "temperature_degC",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Channel:
    """One measured channel: reading in SI = (counts * scale + offset) * factor of its unit."""

    name: str
    unit: str
    scale: float
    offset: float = 0.0

    @property
    def column(self) -> str:
        """Its column in files, for instance displacement_m."""
        return COLUMNS[self.name]

    def to_si(self, counts):
        """Counts (time,) in SI."""
        return (np.asarray(counts, float) * self.scale + self.offset) * SI[self.name][self.unit]


@dataclasses.dataclass(frozen=True)
class Hello:
    """What a device says about itself. `drive`: unit, scale (A a count), limit, table (samples it can hold); None: no drive."""

    device: str
    firmware: str
    boot_id: str
    rate_max: float
    frame_samples: int
    channels: tuple[Channel, ...]
    drive: dict | None = None
    clock_bits: int = 64
    watchdog_s: float = 0.0
    running: bool = False
    last: dict | None = None
    content: dict = dataclasses.field(default_factory=dict)


def whole(payload: bytes) -> bool:
    """Is a payload from a device at least as long as its kind? (Its CRC fits: a shorter one is an error of the firmware.)"""
    return len(payload) >= SHORTEST.get(payload[0], 2)


def hello_packet(content: dict) -> bytes:
    """HELLO with its JSON."""
    return bytes((HELLO, VERSION)) + json.dumps(content, separators=(",", ":")).encode()


def read_hello(payload: bytes) -> Hello:
    """A HELLO payload as a `Hello`; raises `DeviceError` for a foreign version, a missing key or an unknown unit."""
    if payload[1] != VERSION:
        raise DeviceError(f"the device speaks protocol version {payload[1]}, magjax speaks {VERSION}; load the matching firmware")
    try:
        content = json.loads(payload[2:])
        if content["protocol"] != VERSION:
            raise DeviceError(
                f"the device speaks protocol version {content['protocol']}, magjax speaks {VERSION}; load the matching firmware"
            )
        channels = tuple(_channel(c) for c in content["channels"])
        hello = Hello(
            str(content["device"]), str(content["firmware"]), str(content["boot_id"]), float(content["rate_max_Hz"]),
            int(content["frame_samples"]), channels, content.get("drive"), int(content.get("clock_bits", 64)),
            float(content.get("watchdog_s", 0.0)), bool(content.get("running", False)), content.get("last"), content,
        )  # fmt: skip
        if hello.drive is not None:
            hello = dataclasses.replace(
                hello, drive={**hello.drive, **{k: float(hello.drive[k]) for k in ("scale", "limit", "table")}}
            )
        if hello.last is not None:
            hello = dataclasses.replace(hello, last={k: int(hello.last[k]) for k in LAST})
    except (ValueError, TypeError) as error:
        raise DeviceError(
            f"the device's HELLO cannot be read ({error}); it is not a magjax device, or its firmware is damaged"
        ) from None
    except KeyError as error:
        raise DeviceError(f"the device's HELLO lacks {error}; see docs/protocol.md") from None
    if not channels or hello.frame_samples < 1:
        raise DeviceError("the device's HELLO names no channel or no samples a frame; see docs/protocol.md")
    numbers = {"rate_max_Hz": hello.rate_max, "clock_bits": hello.clock_bits if hello.clock_bits <= 64 else -1}
    numbers |= {f"scale of {c.name}": abs(c.scale) for c in channels}
    numbers |= {f"drive {k}": hello.drive[k] for k in ("scale", "limit", "table")} if hello.drive else {}
    for name, value in numbers.items():
        if not 0 < value < np.inf:
            raise DeviceError(f"the device's HELLO gives {name} = {value:g}; mend the firmware (docs/protocol.md)")
    if not all(np.isfinite(c.offset) for c in channels) or not 0 <= hello.watchdog_s < np.inf:
        raise DeviceError(
            "the device's HELLO gives an offset or watchdog_s that is no number; mend the firmware (docs/protocol.md)"
        )
    names = [c.name for c in channels]
    if len(set(names)) < len(names):
        raise DeviceError(f"the device names two channels alike ({', '.join(names)}); mend the firmware (docs/protocol.md)")
    return hello


def _channel(content: dict) -> Channel:
    name, unit = str(content["name"]), str(content["unit"])
    if name not in SI:
        raise DeviceError(f'the device names a channel "{name}"; known are {", ".join(SI)}')
    if unit not in SI[name]:
        raise DeviceError(f'the device gives channel {name} in "{unit}"; known units are {", ".join(SI[name])}')
    return Channel(name, unit, float(content["scale"]), float(content.get("offset", 0.0)))


@dataclasses.dataclass(frozen=True)
class Frame:
    """A DATA packet: `seq` u32, `time_us` of the first sample, `counts` (samples, channels)."""

    seq: int
    time_us: int
    counts: np.ndarray


def data_packet(seq: int, time_us: int, counts) -> bytes:
    """DATA; `counts`: (samples, channels), i16."""
    counts = np.ascontiguousarray(counts, "<i2")
    return DATA_HEAD.pack(DATA, VERSION, len(counts), seq & 0xFFFFFFFF, time_us) + counts.tobytes()


def read_data(payload: bytes, channels: int) -> Frame | None:
    """A DATA payload as a `Frame`; None where its length does not fit its own count."""
    _, version, count, seq, time_us = DATA_HEAD.unpack_from(payload)
    if version != VERSION or len(payload) != DATA_HEAD.size + 2 * count * channels:
        return None
    return Frame(seq, time_us, np.frombuffer(payload, "<i2", offset=DATA_HEAD.size).reshape(count, channels))


@dataclasses.dataclass(frozen=True)
class Ack:
    """Answer to a command: `status` 0 is done; `value`: the first sequence number after START."""

    command: int
    status: int
    value: int
    text: str


def ack_packet(command: int, status: int = 0, value: int = 0, text: str = "") -> bytes:
    """ACK."""
    return ACK_BODY.pack(ACK, VERSION, command, status, value & 0xFFFFFFFF) + text.encode()


def read_ack(payload: bytes) -> Ack:
    """An ACK payload."""
    _, _, command, status, value = ACK_BODY.unpack_from(payload)
    return Ack(command, status, value, payload[ACK_BODY.size :].decode("utf-8", "replace"))


@dataclasses.dataclass(frozen=True)
class Final:
    """The device's own count of a run, after STOP or its end."""

    reason: int
    run: int
    last_seq: int
    frames: int
    samples: int
    dropped: int


def final_packet(final: Final) -> bytes:
    """FINAL."""
    return FINAL_BODY.pack(
        FINAL, VERSION, final.reason, final.run, final.last_seq & 0xFFFFFFFF, final.frames, final.samples, final.dropped
    )


def read_final(payload: bytes) -> Final:
    """A FINAL payload."""
    return Final(*FINAL_BODY.unpack_from(payload)[2:])


def drive_packets(counts, repeats: int) -> list[bytes]:
    """DRIVE packets that upload a table of counts (i16); the device plays it `repeats` times (0: until STOP)."""
    counts = np.ascontiguousarray(counts, "<i2")
    return [
        DRIVE_HEAD.pack(DRIVE, VERSION, k, len(counts), repeats) + counts[k : k + DRIVE_CHUNK].tobytes()
        for k in range(0, len(counts), DRIVE_CHUNK)
    ]


def generate_packet(samples: int, periods: int, amplitude: int, offset: int, factor: float = 1.0) -> bytes:
    """GENERATE: a sine made on the device, counts; each period's amplitude is `factor` times the last."""
    return GENERATE_BODY.pack(GENERATE, VERSION, samples, periods, amplitude, offset, factor)


def start_packet(run: int, rate: float, samples: int) -> bytes:
    """START of a run at `rate` Hz; `samples` 0: until STOP."""
    return START_BODY.pack(START, VERSION, run, round(1000 * rate), samples)


def bare_packet(kind: int) -> bytes:
    """QUERY, STOP or ALIVE."""
    return bytes((kind, VERSION))
