"""The recorder against a device in memory: answers that are late, lost or senseless; segments, books and resumed logs kept apart."""

import json

import numpy as np
import pytest
import serial

from magjax.acquire import protocol as p
from magjax.acquire import recorder as module
from magjax.acquire.adapters import BinaryAdapter
from magjax.acquire.device import Device
from magjax.acquire.framing import Splitter, encode
from magjax.acquire.log import Log
from magjax.acquire.order import Order
from magjax.acquire.recorder import Recorder
from magjax.acquire.response import PlainResponse
from magjax.errors import ConfigurationError, DeviceError


class MemoryPort:
    """A port without wires. `before(kind)`: bytes that arrive ahead of the answer to a command; `instead(payloads)`: what is sent for them."""

    name = "memory"

    def __init__(self, device, before=lambda kind: b"", instead=lambda payloads: payloads):
        self.device, self.before, self.instead = device, before, instead
        self.splitter, self.out, self.time = Splitter(), b"", 0.0

    def write(self, wire):
        for payload in self.splitter.feed(wire):
            answers = self.device.receive(payload, self.time)
            self.out += self.before(payload[0]) + b"".join(encode(a) for a in answers)

    def read(self, count):
        if not self.out:
            self.time += 0.01
            self.out += b"".join(encode(x) for x in self.instead(self.device.due(self.time, 4, True)))
        chunk, self.out = self.out[:count], self.out[count:]
        return chunk

    @property
    def in_waiting(self):
        return len(self.out)

    def close(self):
        pass


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """bench(port, **order): a recorder on that port."""

    def make(port, **changes):
        monkeypatch.setattr(module, "open_port", lambda name, baud: port)
        values = np.arange(1000) * 5e-5
        given = {"rate": 1e4, "samples": 2000, "drive": {"kind": "table", "values": values.tolist(), "repeats": 0}}
        return Recorder(Order("memory", str(tmp_path / "a.mjlog"), **{**given, **changes}), lambda state: None)

    return make


def events(path, kind):
    return [e for e in Log(path).events if e["event"] == kind]


def test_a_late_hello_is_no_reset(bench):
    """On a slow link QUERY is asked twice; its second answer, "no run is on", comes when START is already on its way."""
    device = Device(PlainResponse(exact=True))
    late = encode(device.hello())
    end = bench(MemoryPort(device, before=lambda kind: late if kind == p.START else b""), drive=None).run()
    assert end["status"] == 0 and end["segments"] == 1 and not events(end["path"], "reset")


def test_what_was_read_before_the_device_gave_up_stays_in_its_segment(bench):
    device = Device(PlainResponse(exact=True))
    first = []

    def instead(payloads):  # the first frames and the watchdog's FINAL come in one piece
        if first or not device.running:
            return payloads
        first.extend(payloads)
        return [*payloads, device.finish(2)]

    end = bench(MemoryPort(device, instead=instead)).run()
    log = Log(end["path"])
    kept = {k: np.concatenate([x[1] + np.arange(len(x[4])) for x in log.pieces if x[0] == k]) for k in (0, 1)}
    assert kept[0].tolist() == list(range(64 * len(first))) and kept[1].tolist() == list(range(2000))
    assert end["received"] + end["lost"] == end["sent"] == 2000 + 64 * len(first)


def test_a_run_whose_acknowledgement_was_lost_is_begun_anew(bench, monkeypatch):
    """The device resets; the link breaks just after it got the next START: what it sends then has no known first number."""
    device = Device(PlainResponse(exact=True), first_seq=70)
    done = []

    class Breaks(MemoryPort):
        def read(self, count):
            if not done and device.frames > 8:
                done.append("reset")
                self.out = encode(device.boot(self.time))
            return super().read(count)

        def write(self, wire):
            super().write(wire)
            if done == ["reset"] and device.running:
                done.append("broken")
                self.out = b""
                raise serial.SerialException("unplugged")

    port = Breaks(device)
    monkeypatch.setattr(module, "try_device", lambda *a: (port, p.read_hello(device.hello())))
    end = bench(port).run()
    assert done == ["reset", "broken"] and end["status"] == 0, end
    log = Log(end["path"])
    kept = np.concatenate([x[1] + np.arange(len(x[4])) for x in log.pieces if x[0] == end["segments"] - 1])
    assert kept.tolist() == list(range(2000)) and end["received"] + end["lost"] == end["sent"]


def test_a_frame_now_and_then_is_no_stall(emulate, order):
    from magjax.acquire.process import record

    made = order(emulate("--watchdog", "30")["port"], rate=20.0, samples=70, stall_s=0.3, give_up_s=1.0)
    end = record(made)
    assert end["status"] == 0 and end["received"] == 70 and not events(made.path, "stall"), end


def test_packets_too_short_for_their_kind_are_dropped():
    adapter = BinaryAdapter()
    adapter.channels = 2
    short = [bytes((kind, 1)) for kind in (p.ACK, p.DATA, p.FINAL)]
    frame = p.data_packet(0, 0, np.zeros((4, 2)))
    wrong = frame[:2] + (9).to_bytes(2, "little") + frame[4:]
    assert adapter.feed(b"".join(encode(x) for x in [*short, wrong])) == [] and adapter.damaged == 4
    assert len(adapter.feed(encode(frame))) == 1


def test_a_log_of_another_calibration_is_not_continued(bench):
    device = Device(PlainResponse(exact=True))
    end = bench(MemoryPort(device)).run()
    header = Log(end["path"]).header
    changed = json.loads(json.dumps(header))
    changed["channels"][0]["scale"] *= 2
    for wrong, words in (({**header, "device": "other"}, "recorded from other"), (changed, "calibration")):
        with pytest.raises(ConfigurationError, match=words):
            bench(MemoryPort(device), resume=True, resume_header=wrong, resume_from=0).run()
    again = bench(MemoryPort(device), resume=True, resume_header=header, resume_from=0).run()
    assert again["status"] == 0 and Log(end["path"]).samples == 4000


def test_a_link_that_breaks_in_the_handshake_is_one_line(bench):
    class Dead(MemoryPort):
        def read(self, count):
            raise serial.SerialException("device reports readiness to read but returned no data")

    with pytest.raises(DeviceError, match="link broke before the device said HELLO"):
        bench(Dead(Device(PlainResponse()))).run()


@pytest.mark.parametrize(("watchdog", "words"), [(2.0, "by the device's watchdog (2 s)"), (0.0, "NOT CONFIRMED")])
def test_a_drive_that_may_still_run_is_not_called_zero(bench, watchdog, words):
    class Deaf(MemoryPort):
        def write(self, wire):
            if not self.device.running:
                super().write(wire)

        def read(self, count):
            return b"" if self.device.frames > 8 else super().read(count)

    device = Device(PlainResponse(exact=True), watchdog_s=watchdog)
    end = bench(Deaf(device), give_up_s=0.2, stop_wait_s=0.2).run()
    assert end["status"] == 6 and "silent" in end["reason"] and words in end["drive_at_zero"]


def test_losses_do_not_hide_why_it_ended(bench):
    device = Device(PlainResponse(exact=True), watchdog_s=1e6)  # its time runs as fast as it is read
    dropped = []

    def lossy(payloads):  # frames in the middle, well after the answer to START
        if device.frames > 20 and len(dropped) < 3 and len(payloads) > 1:
            dropped.append(payloads.pop(0))
        return payloads

    port = MemoryPort(device, instead=lossy)
    end = bench(port, samples=0, max_s=0.3).run()
    assert end["status"] == 0 and end["lost"] > 0
    assert end["reason"] == f"the duration limit of 0.3 s is reached, {end['lost']} samples lost"
