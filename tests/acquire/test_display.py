"""What the terminal shows while recording: one line of counts, and the loop in characters."""

import time

import pytest

from magjax.acquire.display import Live, draw_loop

STATE = {"acknowledged": 640, "received": 700, "lost": 3, "damaged_frames": 1, "bytes": 2_500_000, "disk_free": 5e9, "loop": None}


def test_the_loop_is_drawn_to_its_edges():
    drawn = draw_loop([[0.0, 1.0, 2.0], [0.0, 5.0, 10.0]], 11, 5).splitlines()
    assert drawn[0] == drawn[-2] == "+" + "-" * 11 + "+" and len(drawn) == 8
    assert drawn[1][11] == "o" and drawn[3][6] == "o" and drawn[5][1] == "o"
    assert "0 .. 2 A" in drawn[-1] and "0 .. 10" in drawn[-1]


@pytest.mark.parametrize("loop", [[[0.0, 0.0], [1.0, 1.0]], [[1.0, 2.0]], [[3.0], [4.0]]])
def test_a_flat_loop_and_one_channel_are_drawn(loop):
    assert "o" in draw_loop(loop)


def test_the_line_of_counts(capsys):
    with Live(False) as live:
        live({**STATE, "host_time": 10.0})
        live.told = time.monotonic() - 9
        live({**STATE, "host_time": 11.0, "received": 1700, "acknowledged": 1640})
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("640 samples safe, 3 lost, 1 damaged frames, 2.50 MB written, 5 GB free")
    assert second.startswith("1640 samples safe, 1000/s, 3 lost")
    with Live(True) as live:
        live({**STATE, "host_time": 10.0})
    assert capsys.readouterr().err == ""
