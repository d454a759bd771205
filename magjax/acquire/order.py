"""What to record: port, drive, rate, length, limits, and how patient to be; a value that travels to the recorder as JSON."""

import dataclasses
import json
import secrets

import numpy as np

from ..errors import ConfigurationError, DeviceError
from . import protocol as p

DECAY, DECAY_WIDTH, DECAY_PERIODS = 0.9, 90, 44  # 3960 samples fit a small board


@dataclasses.dataclass
class Order:
    """One recording.

    `drive`: None, {"kind": "sine", "samples", "periods", "amplitude", "offset", "factor"} (A, made on the device) or {"kind": "table",
    "values", "repeats"} (A, uploaded); `rate`: Hz; `samples`: to keep (0: until stopped), after `settle_samples`; `limit_A`: of drive and
    measured current; `about`: what the log's start event states (frequency_Hz, drive); `header`: provenance; `demagnetize`: a decaying sine from the
    limit (or the drive's peak) runs before each start, and is not kept; `text`: columns of a
    text-line device, "" to wait for its header line; `amplifier`: port of a SCPI amplifier; `resume_header`: that of the log to append to. `run`: numbers the run, new for each, so
    that a START sent twice is one run.
    """

    port: str
    path: str
    rate: float = 1e4
    samples: int = 0
    settle_samples: int = 0
    drive: dict | None = None
    baud: int = 2_000_000
    limit_A: float | None = None
    max_s: float | None = None
    durable: bool = False
    resume: bool = False
    resume_from: int = -1
    resume_header: dict = dataclasses.field(default_factory=dict)
    demagnetize: bool = False
    text: str | None = None
    amplifier: str | None = None
    header: dict = dataclasses.field(default_factory=dict)
    about: dict = dataclasses.field(default_factory=dict)
    run: int = dataclasses.field(default_factory=lambda: secrets.randbits(31))
    attempts: int = 5
    stall_s: float = 1.0
    give_up_s: float = 15.0
    boot_wait_s: float = 5.0
    start_wait_s: float = 120.0
    stop_wait_s: float = 3.0
    loop_samples: int = 1000
    scale: float = 1.0
    rate_max: float = 1e9

    @property
    def total_samples(self) -> int:
        """Samples that the device is asked for; 0: until STOP."""
        return self.samples + self.settle_samples if self.samples else 0

    def to_json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Order":
        """From `to_json`."""
        return cls(**json.loads(text))

    def peak(self) -> float:
        """Largest absolute drive, A."""
        if self.drive is None:
            return 0.0
        if self.drive["kind"] == "sine":
            return abs(self.drive["amplitude"]) + abs(self.drive["offset"])
        return float(np.max(np.abs(self.drive["values"])))

    def check_numbers(self) -> None:
        """Refuse what is no number, or one that makes no sense, before any port is opened."""
        positive = {"baud": self.baud, "limit": self.limit_A, "seconds": self.max_s, "give-up": self.give_up_s}
        if self.text is None:
            positive["rate"] = self.rate
        for name, value in positive.items():
            if value is not None and not 0 < value < np.inf:
                raise ConfigurationError(f"--{name} = {value:g}; give a number above zero")
        if not np.isfinite(self.peak()):
            raise ConfigurationError("the drive holds values that are no numbers; give amplitude and offset in A")
        if self.samples < 0 or self.settle_samples < 0:
            raise ConfigurationError(f"{self.samples} samples after {self.settle_samples} to settle; give zero or more")

    def check_limit(self) -> None:
        """Refuse a drive beyond the limit before any port is opened."""
        self.check_numbers()
        if self.limit_A and self.peak() > self.limit_A * (1 + 1e-9):
            raise ConfigurationError(
                f"the drive reaches {self.peak():.4g} A where the limit is {self.limit_A:g} A; lower amplitude or offset, or raise limits.current_A"
            )

    def check(self, hello: p.Hello) -> None:
        """Refuse what the device cannot do; takes over its scale of the drive."""
        self.check_limit()
        if self.text is not None:
            return
        if hello.rate_max and self.rate > hello.rate_max:
            raise ConfigurationError(
                f"{self.rate:g} samples/s are asked for, the device makes {hello.rate_max:g}; take fewer samples a period"
            )
        if self.drive is None:
            return
        if not hello.drive:
            raise DeviceError(
                f"{hello.device} has no drive output; record without a drive (--no-drive) and drive the coil otherwise"
            )
        self.scale, self.rate_max = float(hello.drive["scale"]), hello.rate_max
        if self.peak() > float(hello.drive["limit"]) * (1 + 1e-9):
            raise ConfigurationError(
                f"the drive reaches {self.peak():.4g} A, the device allows {hello.drive['limit']:g} A; lower it"
            )
        room = int(hello.drive["table"])
        if self.drive["kind"] == "table" and len(self.drive["values"]) > room:
            raise ConfigurationError(
                f"the drive has {len(self.drive['values'])} samples, the device holds {room}; take fewer samples a period"
            )

    def _counts(self):
        return np.round(np.asarray(self.drive["values"]) / self.scale).astype("<i2")

    def drive_packets(self) -> list[bytes]:
        """What brings the drive onto the device; without a drive, none."""
        drive = self.drive
        if drive is None:
            return []
        if drive["kind"] == "table":
            return p.drive_packets(self._counts(), drive["repeats"])
        amplitude, offset = round(drive["amplitude"] / self.scale), round(drive["offset"] / self.scale)
        return [p.generate_packet(drive["samples"], drive["periods"], amplitude, offset, drive["factor"])]

    def demagnetizing(self) -> tuple[bytes, float, int]:
        """GENERATE of a sine that dies out to the drive's offset, its rate in Hz and its samples: 50 Hz, down to a hundredth."""
        offset = float(self.drive.get("offset", 0.0)) if self.drive["kind"] == "sine" else 0.0
        amplitude = (self.limit_A or self.peak()) - abs(offset)
        packet = p.generate_packet(DECAY_WIDTH, DECAY_PERIODS, round(amplitude / self.scale), round(offset / self.scale), DECAY)
        return packet, min(50.0 * DECAY_WIDTH, self.rate_max), DECAY_WIDTH * DECAY_PERIODS

    def command(self) -> dict:
        """The drive in counts, for the log's start event: what `commanded` reads."""
        drive = self.drive
        if drive is None:
            return {}
        if drive["kind"] == "table":
            return {"command": {"scale": self.scale, "repeats": drive["repeats"], "counts": self._counts().tolist()}}
        amplitude, offset = round(drive["amplitude"] / self.scale), round(drive["offset"] / self.scale)
        row = {
            "scale": self.scale,
            "repeats": drive["periods"],
            "samples": drive["samples"],
            "amplitude": amplitude,
            "offset": offset,
        }
        return {"command": {**row, "factor": drive["factor"]}}


def commanded(command: dict, index) -> np.ndarray:
    """The commanded current at sample numbers, A, from a start event's `command`."""
    if "counts" in command:
        table = np.asarray(command["counts"], float)
        value, length = table[index % len(table)], len(table) * command["repeats"]
    else:
        width = command["samples"]
        decay = np.float64(np.float32(command["factor"])) ** (index / width)
        value = np.round(command["offset"] + command["amplitude"] * decay * np.sin(2 * np.pi * (index % width) / width))
        length = width * command["repeats"]
    return command["scale"] * (np.where(index < length, value, 0.0) if length else value)
