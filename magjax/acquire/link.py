"""Ports: opening one with a clear word on what is wrong, listing them, finding a device again under another name."""

import glob
import os
import re
import time
from pathlib import Path

import serial

from ..errors import ConfigurationError, DeviceError
from . import protocol as p
from .framing import Splitter, encode

READ = 4096  # bytes a read: large reads with a short timeout, never byte by byte
TIMEOUT = 0.03  # s
LINK_ERRORS = (serial.SerialException, OSError)


def open_port(name: str, baud: int = 2_000_000):
    """An open serial port (a device file, COM name or socket:// address); raises `DeviceError` in one line."""
    local = "://" not in name
    if local and os.name == "posix" and not os.path.exists(name):
        raise DeviceError(f"{name}: no such port; magjax ports lists those there are")
    if local and _others(name):
        raise DeviceError(f"{name}: the port is in use by process {_others(name)[0]}; close that program first")
    options = {"exclusive": True} if local and os.name == "posix" else {}
    try:
        port = serial.serial_for_url(name, baudrate=baud, timeout=TIMEOUT, write_timeout=2.0, **options)
    except (serial.SerialException, OSError, ValueError) as error:
        raise DeviceError(f"{name}: {_reason(error)}") from None
    if local:
        port.reset_input_buffer()
    return port


def _reason(error) -> str:
    text = str(error)
    if "Permission" in text:
        return "no permission to open the port; add your user to the group that owns it (often dialout)"
    if "lock" in text or "busy" in text.lower():
        return "the port is in use by another program; close it first"
    if "refused" in text:
        return "nothing listens there; start the device or magjax emulate --tcp first"
    return f"cannot be opened as a serial port ({text.splitlines()[0]})"


def _others(name) -> list[int]:
    """Other processes that hold a device file open (Linux): a lock alone does not keep a plain open out."""
    target, found = os.path.realpath(name), []
    if not target.startswith("/dev/"):
        return found
    for descriptor in glob.glob("/proc/[0-9]*/fd/*"):
        try:
            if os.readlink(descriptor) == target and int(descriptor.split("/")[2]) != os.getpid():
                found.append(int(descriptor.split("/")[2]))
        except OSError:
            continue
    return found


def list_ports() -> list[dict]:
    """Serial ports of this machine: name, description, identity."""
    from serial.tools import list_ports as tools

    return [
        {"port": c.device, "description": c.description, "identity": c.serial_number or c.hwid} for c in sorted(tools.comports())
    ]


def candidates(name: str) -> list[str]:
    """Names under which a device may come back: its own, then those that differ in the last number."""
    if "://" in name:
        return [name]
    others = sorted(glob.glob(glob.escape(re.sub(r"\d+$", "", name)) + "*"))
    return [name, *[o for o in others if o != name]]


def quick_read(port) -> bytes:
    """What has come, without waiting for a full buffer: for answers, not for streams."""
    chunk = port.read(1)
    return chunk + port.read(port.in_waiting) if chunk else chunk


def ask_hello(port, wait: float, splitter=None) -> p.Hello:
    """The device's HELLO: sent at boot (opening may reset a board) or after QUERY. Raises `DeviceError` after `wait` s."""
    splitter = splitter or Splitter()
    end, ask = time.monotonic() + wait, 0.0
    while time.monotonic() < end:
        try:
            if time.monotonic() > ask:
                port.write(encode(p.bare_packet(p.QUERY)))
                ask = time.monotonic() + 0.4
            chunk = quick_read(port)
        except LINK_ERRORS as error:
            raise DeviceError(f"{port.name}: the link broke before the device said HELLO ({error}); check plug and power") from None
        for payload in splitter.feed(chunk):
            if payload[0] == p.HELLO:
                return p.read_hello(payload)
            if p.whole(payload) and payload[0] == p.ACK and payload[2] == p.QUERY:
                raise DeviceError(f"the device refuses the handshake: {p.read_ack(payload).text}; load the matching firmware")
    heard = (
        f"{splitter.received} bytes came, none of them a frame of the protocol"
        if splitter.received
        else "nothing came; another host may hold the line"
        if "://" in port.name
        else "nothing came"
    )
    raise DeviceError(
        f"{port.name}: no HELLO within {wait:g} s ({heard}); check the port, the baud rate and the firmware (docs/protocol.md)"
    )


def writable(path) -> None:
    """Refuse a target before the device is touched."""
    folder = Path(path).parent
    if Path(path).is_dir():
        raise ConfigurationError(f"{path}: is a folder; give the name of a file in it")
    if not folder.is_dir():
        raise ConfigurationError(f"{path}: the folder {folder} does not exist; make it first")
    if not os.access(folder, os.W_OK):
        raise ConfigurationError(f"{path}: the folder {folder} cannot be written; choose another place")


def shut(port) -> None:
    """Close a port that may be broken."""
    try:
        port.close()
    except LINK_ERRORS:
        return


def try_device(name, baud, wanted, wait: float = 1.0):
    """(port, hello) where the device with the HELLO `wanted` answers at this name, else None; `wanted` None: any, hello None."""
    try:
        port = open_port(name, baud)
    except DeviceError:
        return None
    if wanted is None:
        return port, None
    try:
        hello = ask_hello(port, wait)
        if hello.device == wanted.device:
            return port, hello
    except DeviceError:
        pass  # not this one; the next name is tried
    shut(port)
    return None
