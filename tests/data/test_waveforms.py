"""Drives: their lines, their extremes, their order of reversals; wrong use in one line."""

import numpy as np
import pytest

from magjax import waveforms as w
from magjax.errors import ConfigurationError
from magjax.recording import fundamental


def test_a_sweep_set_is_the_whole_grid_within_its_limit():
    drives = w.sweep_set([10, 20], [0.2, 0.5], [0.0, 0.1], samples=100)
    assert len(drives) == 8 and {d.frequency for d in drives} == {10.0, 20.0}
    assert max(d.peak for d in drives) == pytest.approx(0.6)
    with pytest.raises(ConfigurationError, match="lower its amplitude"):
        w.sweep_set([10], [0.5], [0.5], limit=0.9)


def test_a_decaying_drive_reverses_inside_itself_and_ends_at_the_offset():
    drive = w.decaying(5, 0.8, 0.1, decay=0.8, samples=400)
    x = drive.values
    turns = x[1:-1][(x[1:-1] - x[:-2]) * (x[2:] - x[1:-1]) < 0] - 0.1
    assert np.all(np.sign(turns[1:]) == -np.sign(turns[:-1])) and np.all(np.diff(np.abs(turns)) < 0)
    assert abs(x[-1] - 0.1) < 1e-9 and abs(turns[-1]) < 0.01 and drive.frequency is None


def test_reversal_curves_meet_every_level_at_one_rate():
    drive = w.reversal_curves(-1.0, 1.0, 8, rate=2.0)
    x = drive.values
    valleys = x[1:-1][(x[1:-1] < x[:-2]) & (x[1:-1] < x[2:])]
    assert valleys == pytest.approx(1 - 2 * np.arange(1, 9) / 8, abs=1e-12)
    assert np.abs(np.diff(x)).max() / drive.dt == pytest.approx(2.0, rel=0.02)
    assert x[0] == x[-1] == 1.0


def test_a_multisine_has_its_lines_alone_and_a_low_crest():
    drive = w.multisine([10, 20, 30, 50, 70, 90], 0.5, 0.1, periods=2, samples=1000)
    lines = np.abs(np.fft.rfft(drive.values)) / len(drive.values)
    there = np.flatnonzero(lines > 1e-9)
    assert drive.frequency == 10 and list(there) == [0, 2, 4, 6, 10, 14, 18]
    assert lines[2:].max() == pytest.approx(lines[there[1:]].min())
    ac = drive.values - 0.1
    assert np.max(np.abs(ac)) == pytest.approx(0.5) and 0.5 / ac.std() < 2.9


def test_a_modulated_sine_repeats_at_its_modulation():
    drive = w.modulated_sine(60, 6, 0.4, depth=0.5, periods=3)
    assert fundamental(drive.values, drive.dt) == pytest.approx(6, rel=1e-6)
    assert drive.peak <= 0.4 and drive.peak > 0.39


@pytest.mark.parametrize(
    "wrong",
    [lambda: w.sine(0, 1), lambda: w.sine(10, np.nan), lambda: w.sine(10, 1, samples=0), lambda: w.decaying(1, 1, decay=1.2),
     lambda: w.reversal_curves(1, 0, 3, 1), lambda: w.multisine([1, np.pi], 1), lambda: w.multisine([1, 900], 1), lambda: w.modulated_sine(10, 3, 1)],
)  # fmt: skip
def test_wrong_use_is_one_line(wrong):
    with pytest.raises(ConfigurationError) as error:
        wrong()
    assert "\n" not in str(error.value)
