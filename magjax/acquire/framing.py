"""Frames on a byte stream: payload + CRC-32, COBS, a zero byte between frames (docs/protocol.md).

COBS (S. Cheshire and M. Baker, IEEE/ACM Trans. Networking 7, 1999) keeps zero out of the frame, so that after any damage
the next zero byte is the start of something new. A frame whose CRC-32 (that of zlib) does not fit is never passed on.
"""

import zlib

from cobs import cobs

LONGEST = 1 << 16  # bytes that may pass without a zero before they are given up as noise


def encode(payload: bytes) -> bytes:
    """One frame as it goes on the wire: COBS(payload, CRC-32 little endian) and a zero byte."""
    return cobs.encode(payload + zlib.crc32(payload).to_bytes(4, "little")) + b"\0"


class Splitter:
    """Bytes in, whole and correct payloads out, in pieces of any size.

    Counts what it threw away: `damaged` frames (COBS or CRC-32 wrong), `idle` zero bytes, and all `received` bytes.
    """

    def __init__(self):
        self.damaged = 0
        self.idle = 0
        self.received = 0
        self._rest = b""

    def feed(self, chunk: bytes) -> list[bytes]:
        """Payloads completed by this chunk, in order."""
        self.received += len(chunk)
        *frames, self._rest = (self._rest + chunk).split(b"\0")
        if len(self._rest) > LONGEST:
            self._rest, self.damaged = b"", self.damaged + 1
        payloads = []
        for frame in frames:
            if not frame:
                self.idle += 1
                continue
            payload = decode(frame)
            if payload is None:
                self.damaged += 1
            else:
                payloads.append(payload)
        return payloads

    def forget(self) -> None:
        """Drop a half frame: after a port was opened again."""
        self._rest = b""


def decode(frame: bytes) -> bytes | None:
    """The payload of one frame without its zero byte; None where COBS or CRC-32 does not fit."""
    try:
        content = cobs.decode(frame)
    except cobs.DecodeError:
        return None
    if len(content) < 6 or zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
        return None
    return content[:-4]
