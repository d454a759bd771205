"""Question and answer with a device: a command until it is acknowledged, a decaying drive to demagnetize, a run left behind.

`link` is whoever holds the port: an object with `port`, `adapter` and `check_stop()`, which raises where the user wants an end.
"""

import secrets
import time

from ..errors import DeviceError
from . import protocol as p
from .framing import encode
from .link import READ, quick_read

REPEAT = 0.5  # s after which a command is sent again


def command(link, packet: bytes, kind: int, wait: float):
    """Send a command until it is acknowledged: (its `Ack`, what else came meanwhile and belongs to the run it started).

    A HELLO that comes before the acknowledgement answers an earlier question and is dropped. Raises `DeviceError` where
    the device refuses, or does not answer within `wait` s.
    """
    end, again, others = time.monotonic() + wait, 0.0, []
    while time.monotonic() < end:
        link.check_stop()
        if time.monotonic() > again:
            link.port.write(encode(packet))
            again = time.monotonic() + REPEAT
        answer = None
        for found, value in link.adapter.feed(quick_read(link.port)):
            if found == p.ACK and value[2] == kind:
                answer = answer or p.read_ack(value)
            elif found != p.HELLO or answer is not None:
                others.append((found, value))
        if answer is not None:
            if answer.status:
                raise DeviceError(f"the device refuses {p.NAMES[kind]}: {answer.text}")
            return answer, others
    raise DeviceError(f"{link.port.name}: the device does not acknowledge {p.NAMES[kind]} within {wait:g} s; check the link")


def demagnetize(link, order, hello) -> None:
    """A decaying sine; its samples are not kept. Raises `DeviceError` where it does not end."""
    packet, rate, samples = order.demagnetizing()
    command(link, packet, p.GENERATE, order.stop_wait_s + 2.0)
    command(link, p.start_packet(secrets.randbits(31), rate, samples), p.START, order.start_wait_s)
    end, alive = time.monotonic() + samples / rate + order.stop_wait_s + 2.0, 0.0
    while time.monotonic() < end:
        link.check_stop()
        if time.monotonic() > alive:
            link.port.write(encode(p.bare_packet(p.QUERY)))  # keeps the watchdog quiet, and tells when the run is over
            alive = time.monotonic() + 0.25 * (hello.watchdog_s or 2.0)
        for kind, value in link.adapter.feed(link.port.read(READ)):
            if kind == p.FINAL or (kind == p.HELLO and not p.read_hello(value).running):
                return
    raise DeviceError(f"{link.port.name}: the demagnetizing drive did not end; check the link")


def end_foreign_run(link, wait: float) -> None:
    """Stop a run that a killed recorder left behind."""
    end, over = time.monotonic() + wait, False
    link.port.write(encode(p.bare_packet(p.STOP)))
    while not over and time.monotonic() < end:
        over = any(kind == p.FINAL for kind, _ in link.adapter.feed(link.port.read(READ)))
