"""Frames and packets: round trips, damage, and the protocol page against the code."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magjax.acquire import protocol as p
from magjax.acquire.framing import Splitter, encode
from magjax.errors import DeviceError

ROOT = Path(__file__).resolve().parents[2]
HELLO = {
    "protocol": 1, "device": "bench 1", "firmware": "1.0", "boot_id": "a", "rate_max_Hz": 1e4, "frame_samples": 8,
    "channels": [{"name": "current", "unit": "mA", "scale": 0.05}, {"name": "displacement", "unit": "um", "scale": 0.002, "offset": 1.0}],
}  # fmt: skip


@given(st.lists(st.binary(min_size=2, max_size=400), min_size=1, max_size=12), st.integers(1, 50))
def test_payloads_survive_any_cutting(payloads, width):
    wire = b"".join(encode(x) for x in payloads)
    splitter, found = Splitter(), []
    for k in range(0, len(wire), width):
        found += splitter.feed(wire[k : k + width])
    assert found == payloads and splitter.damaged == 0 and splitter.received == len(wire)


@given(st.lists(st.binary(min_size=20, max_size=80), min_size=3, max_size=8), st.data())
def test_damage_is_never_passed_on(payloads, data):
    wire = bytearray(b"".join(encode(x) for x in payloads))
    at = data.draw(st.integers(0, len(wire) - 1))
    wire[at] ^= 1 << data.draw(st.integers(0, 7))
    splitter = Splitter()
    found = splitter.feed(bytes(wire)) + splitter.feed(b"\0")
    assert all(x in payloads for x in found)
    # one flipped bit costs one frame, or two where it hit the zero between them
    assert len(payloads) - 2 <= len(found) <= len(payloads) - 1


def test_a_storm_of_zeros_and_endless_noise_cost_nothing_else():
    splitter = Splitter()
    assert splitter.feed(b"\0" * 100000) == [] and splitter.idle == 100000
    assert splitter.feed(b"\1" * 200000) == [] and splitter.damaged == 1
    splitter.feed(b"\0")
    assert splitter.feed(encode(b"alive")) == [b"alive"]


def test_packets_round_trip():
    counts = np.arange(-6, 6, dtype="<i2").reshape(6, 2)
    frame = p.read_data(p.data_packet(2**32 + 7, 123456789012, counts), 2)
    assert (frame.seq, frame.time_us) == (7, 123456789012) and np.array_equal(frame.counts, counts)
    assert p.read_data(p.data_packet(1, 2, counts)[:-1], 2) is None
    final = p.Final(1, 3, 9, 10, 640, 2)
    assert p.read_final(p.final_packet(final)) == final
    assert p.read_ack(p.ack_packet(p.START, 0, 17, "ok")) == p.Ack(p.START, 0, 17, "ok")
    table = np.arange(250)
    parts = p.drive_packets(table, 4)
    assert [len(x) for x in parts] == [p.DRIVE_HEAD.size + 200] * 2 + [p.DRIVE_HEAD.size + 100]


def test_hello_gives_channels_in_si():
    hello = p.read_hello(p.hello_packet(HELLO))
    assert hello.channels[0].to_si([100])[0] == pytest.approx(5e-3)
    assert hello.channels[1].to_si([500])[0] == pytest.approx(2e-6)
    assert [c.column for c in hello.channels] == ["current_A", "displacement_m"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"protocol": 2}, "version 2"),
        ({"channels": [{"name": "displacement", "unit": "furlong", "scale": 1}]}, "furlong"),
        ({"channels": [{"name": "colour", "unit": "A", "scale": 1}]}, "colour"),
        ({"channels": []}, "no channel"),
        ({"rate_max_Hz": None}, "cannot be read"),
        ({"rate_max_Hz": 0}, "rate_max_Hz = 0"),
        ({"channels": [{"name": "current", "unit": "A", "scale": float("nan")}]}, "scale of current = nan"),
        ({"channels": [{"name": "current", "unit": "A", "scale": 0}]}, "scale of current = 0"),
        ({"channels": [{"name": "current", "unit": "A", "scale": 1}] * 2}, "two channels alike"),
        ({"channels": 7}, "cannot be read"),
        ({"clock_bits": 65}, "clock_bits"),
        ({"drive": {"scale": 1e-4, "limit": 1}}, "lacks 'table'"),
        ({"drive": {"scale": 0, "limit": 1, "table": 9}}, "drive scale = 0"),
        ({"last": {"run": 3}}, "lacks 'reason'"),
        ({"last": "none"}, "cannot be read"),
    ],
)
def test_a_wrong_hello_is_one_clear_line(change, words):
    with pytest.raises(DeviceError, match=words) as caught:
        p.read_hello(p.hello_packet({**HELLO, **change}))
    assert "\n" not in str(caught.value)
    short = {k: v for k, v in HELLO.items() if k != "firmware"}
    with pytest.raises(DeviceError, match="firmware"):
        p.read_hello(bytes((p.HELLO, 1)) + json.dumps(short).encode())


def test_the_page_and_the_code_agree():
    page = (ROOT / "docs" / "protocol.md").read_text()
    stated = {int(a, 16): b for a, b in re.findall(r"^\| (0x[0-9a-f]{2}) \| (\w+) \|", page, re.M)}
    assert stated == p.NAMES
    for quantity, units in p.SI.items():
        assert f"{quantity} {' '.join(units)}" in re.sub(r"\s+", " ", page)
    sizes = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i16": 2, "f32": 4}
    bodies = {"GENERATE": p.GENERATE_BODY, "START": p.START_BODY, "FINAL": p.FINAL_BODY}
    for name, body in bodies.items():
        text = re.search(rf"\| {name} \| `([^`]*)`", page).group(1)
        assert 2 + sum(sizes[w.split()[1]] for w in text.split(",")) == body.size
    for number, reason in p.REASONS.items():
        assert f"{number} {reason.split(':')[0]}" in page


def test_the_firmware_sketch_speaks_the_page():
    text = (ROOT / "firmware" / "magjax_bench" / "magjax_bench.ino").read_text()
    stated = dict(re.findall(r"\b([A-Z]+) = (0x[0-9a-f]{2})", text))
    assert {v: int(k, 16) for v, k in stated.items()} == {name: number for number, name in p.NAMES.items() if name != "NOTE"}
    sizes = {"DRIVE": p.DRIVE_HEAD.size, "GENERATE": p.GENERATE_BODY.size, "START": p.START_BODY.size}
    for name, size in sizes.items():
        assert int(re.search(rf"kind == {name} && n >= (\d+)", text).group(1)) == size
    assert int(re.search(r"sendFrame\(p, (\d+), false\);\n\}\n\n// --- the run", text).group(1)) == p.FINAL_BODY.size
    hello = re.search(r'"(\{\\"protocol.*?)",\n', text, re.S).group(1)
    calibration = re.search(r"CALIBRATION =\n(.*?);", text, re.S).group(1)
    joined = "".join(re.findall(r'"((?:[^"\\]|\\.)*)"', '"' + hello + '"')).replace('\\"', '"')
    filled = "".join(re.findall(r'"((?:[^"\\]|\\.)*)"', calibration)).replace('\\"', '"')
    for mark, value in ((r"%08lx", "0a"), (r"%s", "true"), (r"%s", filled)):
        joined = joined.replace(mark, value, 1)
    made = json.loads(re.sub(r"%lu|%d", "32", joined))
    hello = p.read_hello(p.hello_packet(made))
    assert (
        hello.clock_bits == 32
        and [c.column for c in hello.channels] == ["current_A", "displacement_m"]
        and hello.drive["limit"] < 1
    )
