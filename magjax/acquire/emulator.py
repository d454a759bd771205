"""The emulated bench as a process: a device (device.py) behind a pseudo-terminal or a TCP port, with faults on the way.

A pseudo-terminal holds its writer back where a UART would lose bytes. So nothing here waits in real time: what does not fit into the
device's own buffer is dropped, frame by frame, and counted by the device. `fast` waits instead and loses nothing.
"""

import errno
import os
import select
import socket
import time
from pathlib import Path

from ..errors import DeviceError
from .framing import Splitter, encode

BUFFER = 1 << 16  # bytes that the device can hold back
ALLOWANCE = 0.02  # s of line time that may be sent at once
BATCH = 32  # frames a turn


class Line:
    """What both kinds of wire share: a buffer, and at most `baud` / 10 bytes a second out of it."""

    def __init__(self, baud: float | None = None):
        self.baud, self.out = baud, bytearray()
        self.credit, self.last = 0.0, time.monotonic()

    def offer(self, wire: bytes, always: bool = False) -> bool:
        """Take bytes for sending; False where they do not fit."""
        if not always and len(self.out) + len(wire) > BUFFER:
            return False
        self.out += wire
        return True

    def flush(self) -> None:
        """Send what the line takes now."""
        count = len(self.out)
        if self.baud:
            now = time.monotonic()
            self.credit = min(self.credit + (now - self.last) * self.baud / 10, ALLOWANCE * self.baud / 10)
            self.last = now
            count = min(count, int(self.credit))
        if count:
            sent = self.send(bytes(self.out[:count]))
            del self.out[:sent]
            self.credit -= sent


class PtyLine(Line):
    """A pseudo-terminal; `link`: a name that points to it; after it was unplugged it comes back with a number behind."""

    def __init__(self, link=None, baud=None):
        super().__init__(baud)
        self.link, self.number = link, 0
        self.plug()

    def plug(self) -> None:
        """Open a new pseudo-terminal."""
        import tty

        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(slave)
        os.close(slave)
        self.place = None
        if self.link:
            self.place = Path(f"{self.link}{self.number or ''}")
            if self.place.exists() and not self.place.is_symlink():
                raise DeviceError(f"--link {self.link}: {self.place} is there and no link; choose another name")
            try:
                self.place.unlink(missing_ok=True)
                self.place.symlink_to(self.name)
            except OSError as error:
                raise DeviceError(
                    f"--link {self.link}: {self.place} cannot be made ({error.strerror}); choose another name"
                ) from None
            self.name = str(self.place)
        self.out.clear()

    def unplug(self) -> None:
        """The port vanishes; the next one has another name."""
        os.close(self.master)
        if self.place:
            self.place.unlink(missing_ok=True)
        self.number += 1

    def wait(self, seconds: float, sending: bool) -> None:
        """Until something can be read (or sent)."""
        readable, _, _ = select.select([self.master], [self.master] if sending else [], [], seconds)
        self.readable = bool(readable)

    def receive(self) -> bytes:
        """What came in; nothing while no host has the port open."""
        if not self.readable:
            return b""
        try:
            return os.read(self.master, 65536)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            time.sleep(0.002 if self.out else 0.02)  # no host: select returns at once then
            return b""

    def send(self, wire: bytes) -> int:
        """Bytes taken."""
        try:
            return os.write(self.master, wire)
        except BlockingIOError:
            return 0
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return len(wire)

    def close(self) -> None:
        """Close and remove the name."""
        self.unplug()


class TcpLine(Line):
    """A TCP port on this machine, for one host at a time: socket://127.0.0.1:PORT."""

    def __init__(self, port: int, baud=None):
        super().__init__(baud)
        if not 0 <= port < 65536:
            raise DeviceError(f"TCP port {port}: not within 0 .. 65535; choose another, or 0 for a free one")
        try:
            self.server = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise DeviceError(f"TCP port {port}: {error.strerror}; choose another, or 0 for a free one") from None
        self.server.setblocking(False)
        self.name = f"socket://127.0.0.1:{self.server.getsockname()[1]}"
        self.host = None

    def plug(self) -> None:
        """Accept hosts again."""
        self.out.clear()

    def unplug(self) -> None:
        """Cut the connection."""
        if self.host:
            self.host.close()
            self.host = None

    def wait(self, seconds: float, sending: bool) -> None:
        """Until a host comes, or something can be read (or sent)."""
        wire = self.host or self.server
        readable, _, _ = select.select([wire], [wire] if sending and self.host else [], [], seconds)
        self.readable = bool(readable)
        if self.readable and self.host is None:
            self.host, _ = self.server.accept()
            self.host.setblocking(False)
            self.host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.out.clear()
            self.readable = False

    def receive(self) -> bytes:
        """What came in."""
        if not self.readable or self.host is None:
            return b""
        try:
            chunk = self.host.recv(65536)
        except BlockingIOError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            self.unplug()
        return chunk

    def send(self, wire: bytes) -> int:
        """Bytes taken; all of them are lost while no host is there."""
        if self.host is None:
            return len(wire)
        try:
            return self.host.send(wire)
        except BlockingIOError:
            return 0
        except OSError:
            self.unplug()
            return len(wire)

    def close(self) -> None:
        """Close both."""
        self.unplug()
        self.server.close()


class Emulator:
    """Device, line and faults; `step` runs one turn of the loop."""

    def __init__(self, device, line, faults, fast: bool = False):
        self.device, self.line, self.faults, self.fast = device, line, faults, fast
        self.splitter = Splitter()
        self.sent = 0
        self.silent_until = 0.0
        self.happened = set()
        line.offer(encode(device.hello()))

    def run(self) -> None:
        """Until interrupted."""
        try:
            while True:
                self.step()
        finally:
            self.line.close()

    def step(self) -> None:
        """One turn: read, answer, make the frames that are due, send."""
        now, line, device = time.monotonic(), self.line, self.device
        idle = 0.002 if device.running or line.out else 0.02
        line.wait(0.0 if self.fast and device.running and len(line.out) < BUFFER // 2 else idle, bool(line.out) and not line.baud)
        for payload in self.splitter.feed(line.receive()):
            for answer in device.receive(payload, now):
                line.offer(self.faults.mangle(encode(answer)), always=True)
        if now < self.silent_until:
            self._drop_due(now)
            return
        if not (self.fast and len(line.out) > BUFFER // 2):
            for payload in device.due(time.monotonic(), BATCH, self.fast):
                self._send(payload)
        self._single_events()
        line.flush()

    def _send(self, payload):
        data = payload[0] == 0x83
        fits = self.line.offer(self.faults.mangle(encode(payload)), always=not data or self.fast)
        self.sent += data
        if not fits:
            self.device.dropped += 1

    def _drop_due(self, now):
        """During a stall the device measures on and loses what it cannot keep."""
        for payload in device_due(self.device, now, self.fast):
            if payload[0] == 0x83:
                self.sent += 1
                self.device.dropped += 1
            else:
                self.line.offer(encode(payload), always=True)

    def _once(self, name, when):
        if not getattr(self.faults, name) or name in self.happened or self.sent < when:
            return False
        self.happened.add(name)
        return True

    def _single_events(self):
        faults, line = self.faults, self.line
        if self._once("zeros", faults.at):
            line.offer(bytes(int(faults.zeros)), always=True)
        if self._once("reset", faults.reset):
            line.out.clear()
            line.offer(encode(self.device.boot(time.monotonic())), always=True)
        if self._once("stall", faults.at):
            self.silent_until = time.monotonic() + faults.stall
        if self._once("unplug", faults.at):
            line.unplug()
            time.sleep(faults.unplug)
            line.plug()


def device_due(device, now, fast):
    """What is due during a stall: nothing in fast mode, where time stands still."""
    return [] if fast else device.due(now, BATCH, False)
