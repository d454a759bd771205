"""Other devices behind the recorder's interface: text lines for the data, SCPI for the amplifier's set-up.

A data adapter has `feed(bytes) -> [(kind, value)]`, `damaged`, `received`, `forget()`; an amplifier has `set_up()`, `off()`.
"""

import re
import time

import numpy as np

from ..errors import ConfigurationError, DeviceError
from . import protocol as p
from .framing import Splitter
from .link import open_port


class BinaryAdapter:
    """The protocol's frames: (type, payload or `Frame`)."""

    def __init__(self):
        self.splitter = Splitter()
        self.channels = 0
        self.misfits = 0

    @property
    def damaged(self) -> int:
        """Frames thrown away."""
        return self.splitter.damaged + self.misfits

    @property
    def received(self) -> int:
        """Bytes."""
        return self.splitter.received

    def forget(self) -> None:
        """After reopening."""
        self.splitter.forget()

    def feed(self, chunk: bytes):
        """Messages completed by this chunk."""
        messages = []
        for payload in self.splitter.feed(chunk):
            kind = payload[0]
            if not p.whole(payload):
                self.misfits += 1
                continue
            if kind != p.DATA:
                messages.append((kind, payload))
                continue
            frame = p.read_data(payload, self.channels) if self.channels else None
            if frame is None:
                self.misfits += 1
            else:
                messages.append((kind, frame))
        return messages


class TextAdapter:
    """Lines `seq,t_us,value,...` after one line `# seq,t_us,current_mA,displacement_um` (or columns given beforehand)."""

    def __init__(self, columns: str | None = None):
        self.hello = None
        self.damaged = self.received = 0
        self._rest = b""
        if columns:
            self.hello = _text_hello(columns)

    def forget(self) -> None:
        """After reopening."""
        self._rest = b""

    def feed(self, chunk: bytes):
        """Messages completed by this chunk; runs of consecutive lines become one `Frame` of floats."""
        self.received += len(chunk)
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        rows, messages = [], []
        for line in lines:
            if line.startswith(b"#"):
                self._take_header(line[1:].decode("ascii", "replace").strip())
                continue
            row = self._row(line)
            if row is not None:
                rows.append(row)
        begin = 0
        for k in range(1, len(rows) + 1):
            if k == len(rows) or rows[k][0] != rows[k - 1][0] + 1:
                block = np.array([r[2:] for r in rows[begin:k]], float)
                messages.append((p.DATA, p.Frame(int(rows[begin][0]), int(rows[begin][1]), block)))
                begin = k
        return messages

    def _take_header(self, text):
        """The line of column names; other remarks of the device are passed over."""
        if not text.startswith("seq"):
            return
        fresh = _text_hello(text)
        if self.hello is not None and fresh.channels != self.hello.channels:
            raise DeviceError(f"the device's columns are now {text}, which are not those of this recording; record anew")
        self.hello = self.hello or fresh

    def _row(self, line):
        if not line.strip() or self.hello is None:
            return None
        try:
            row = [int(v) if k < 2 else float(v) for k, v in enumerate(line.split(b","))]
        except ValueError:
            self.damaged += 1
            return None
        if len(row) != 2 + len(self.hello.channels) or not np.all(np.isfinite(row)):
            self.damaged += 1
            return None
        return row


def _text_hello(columns: str) -> p.Hello:
    channels = []
    names = [c.strip() for c in columns.split(",")]
    for name in [n for n in names if n not in ("seq", "t_us")]:
        match = re.fullmatch(rf"({'|'.join(p.SI)})_(\w+)", name)
        unit = match.group(2).replace("_per_", "/") if match else ""
        if not match or unit not in p.SI[match.group(1)]:
            raise DeviceError(
                f'text column "{name}" is no quantity with a unit; write for instance seq,t_us,current_mA,displacement_um'
            )
        channels.append(p.Channel(match.group(1), unit, 1.0))
    if not channels:
        raise DeviceError("the text columns name no channel; write for instance seq,t_us,current_mA,displacement_um")
    return p.Hello("text lines", "unknown", "", 0.0, 1, tuple(channels))


class ScpiAmplifier:
    """Set-up of a bipolar amplifier by SCPI over RS-232 (written for the Kepco BOP): current mode, limit, output on, and off again.

    9600 baud with XON/XOFF, as such amplifiers come: for set-up and quasi-static work; the waveform goes to its analog input.
    """

    def __init__(self, port: str, limit: float, volts: float = 20.0, baud: int = 9600):
        self.limit, self.volts = limit, volts
        self.port = open_port(port, baud)
        if "://" not in port:
            self.port.xonxoff = True

    def ask(self, question: str, wait: float = 2.0) -> str:
        """The answer to one question; raises `DeviceError` where none comes."""
        self.port.write(question.encode() + b"\n")
        answer, end = b"", time.monotonic() + wait
        while time.monotonic() < end and not answer.endswith(b"\n"):
            answer += self.port.read(256)
        if not answer.endswith(b"\n"):
            raise DeviceError(
                f"{self.port.name}: the amplifier does not answer {question}; check its address, baud rate and XON/XOFF"
            )
        return answer.decode("ascii", "replace").strip()

    def set_up(self) -> str:
        """Current mode, zero current, voltage bound, output on; returns the amplifier's identity."""
        identity = self.ask("*IDN?")
        for command in ("FUNC:MODE CURR", "CURR 0", f"VOLT {self.volts:g}", "OUTP ON"):
            self.port.write(command.encode() + b"\n")
        trouble = self.ask("SYST:ERR?")
        if not trouble.startswith(("0", "+0")):
            self.off()
            raise DeviceError(f"{self.port.name}: the amplifier {identity} reports {trouble}; mend that first")
        return identity

    def level(self, current: float) -> None:
        """A constant current in A, within the limit."""
        if abs(current) > self.limit:
            raise ConfigurationError(f"a current of {current:g} A is beyond the limit of {self.limit:g} A")
        self.port.write(f"CURR {current:.6g}\n".encode())

    def off(self) -> None:
        """Zero current, output off."""
        for command in ("CURR 0", "OUTP OFF"):
            self.port.write(command.encode() + b"\n")
        self.port.flush()
