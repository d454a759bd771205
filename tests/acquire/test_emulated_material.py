"""The emulated bench remembers its runs: against one long simulation, and what demagnetizing between runs is for."""

import numpy as np
import pytest

from magjax.acquire import protocol as p
from magjax.acquire.device import DRIVE_SCALE, Device
from magjax.acquire.material import MOST, Material
from magjax.acquire.order import DECAY, DECAY_PERIODS, DECAY_WIDTH
from magjax.acquire.response import BenchResponse
from magjax.bench import load_bench
from magjax.extrema import wiped
from magjax.simulate import simulate

WIDTH, RATE = 200, 4000.0


@pytest.fixture(scope="module")
def bench():
    return load_bench("aa-050h")


def device(bench, seed=0):
    return Device(BenchResponse(bench, {}), noise=False, seed=seed)


def play(box, amplitude, offset=0.0, periods=3, factor=1.0, width=WIDTH, rate=RATE, run=[0]):
    """Readings of a run of the device, (samples, 2) in A and m."""
    run[0] += 1
    counts = [round(x / DRIVE_SCALE) for x in (amplitude, offset)]
    sent = box.receive(p.generate_packet(width, periods if factor != 1.0 else 0, *counts, factor), 0.0)
    assert p.read_ack(sent[0]).status == 0
    samples = periods * width
    assert p.read_ack(box.receive(p.start_packet(run[0], rate, samples), 0.0)[0]).status == 0
    blocks = []
    while box.running:
        blocks += [p.read_data(x, 2).counts for x in box.due(0.0, 1000, True) if x[0] == p.DATA]
    table = np.concatenate(blocks) * [[c["scale"] for c in box.response.channels]] + [[c["offset"] for c in box.response.channels]]
    return table * [1.0, 1e-6]


def demagnetize(box, amplitude=0.9, offset=0.0):
    play(box, amplitude, offset, DECAY_PERIODS, DECAY, DECAY_WIDTH, 50.0 * DECAY_WIDTH)


@pytest.mark.long
def test_two_runs_are_one_long_simulation(bench):
    box = device(bench)
    played = [play(box, 0.85, 0.0)[-WIDTH:], play(box, 0.3, 0.2)[-WIDTH:], play(box, 0.2, -0.3)[-WIDTH:]]
    phase = 2 * np.pi * np.arange(3 * WIDTH) / WIDTH
    gap = np.zeros(40)
    runs = [0.85 * np.sin(phase), 0.2 + 0.3 * np.sin(phase), -0.3 + 0.2 * np.sin(phase)]
    whole = np.asarray(simulate(bench.actuator(), np.concatenate([x for r in runs for x in (r, gap)]), 1 / RATE).reading)
    for k, got in enumerate(played):
        expected = whole[k * (3 * WIDTH + 40) :][2 * WIDTH : 3 * WIDTH]
        assert np.abs(got[:, 1] - expected).max() < 2e-3 * np.ptp(whole), k
    alone = play(device(bench), 0.2, -0.3)[-WIDTH:]
    assert np.abs(alone[:, 1] - played[2][:, 1]).max() > 0.02 * np.ptp(whole)  # the past shows


@pytest.mark.long
def test_a_reversal_after_a_run_starts_where_that_one_ended(bench):
    box = device(bench)
    play(box, 0.6)
    got = play(box, 0.3, 0.0, 2, 0.5)[:, 1]  # a transient drive, from the memory
    phase = 2 * np.pi * np.arange(3 * WIDTH) / WIDTH
    k = np.arange(2 * WIDTH)
    parts = [0.6 * np.sin(phase), np.zeros(200), 0.3 * 0.5 ** (k / WIDTH) * np.sin(2 * np.pi * k / WIDTH)]
    whole = np.asarray(simulate(bench.actuator(), np.concatenate(parts), 1 / RATE).reading)
    assert np.abs(got - whole[-2 * WIDTH :]).max() < 5e-3 * np.ptp(whole)


@pytest.mark.long
def test_demagnetizing_between_runs_takes_the_past_away(bench):
    after = {}
    for clean in (False, True):
        for before in (-0.45, 0.45):
            box = device(bench)
            play(box, 0.45, before)
            if clean:
                demagnetize(box)
            after[clean, before] = play(box, 0.25, 0.1)[-WIDTH:, 1]
    left = {clean: np.abs(after[clean, -0.45] - after[clean, 0.45]).max() for clean in (False, True)}
    assert left[False] > 5e-7 and left[True] < 0.1 * left[False]


def test_corners_are_wiped_out_and_few_keep_the_outermost():
    assert wiped([0, 5, 2, 3, 1, 4]) == [0, 5, 1, 4] and wiped([0, 5, 1, 6]) == [0, 6]
    rng = np.random.default_rng(0)
    material = Material(np.tril(rng.random((12, 12))), -10.0, 10.0, 0.0, 9 * 0.9 ** np.arange(60) * (-1.0) ** np.arange(60))
    few = material.few()
    assert len(few) == MOST and few[0] == 9.0 and few[-1] == material.past[-1] and np.all(np.diff(np.abs(few)) < 0)
    assert len(Material(np.eye(3), -1, 1, 0).few()) == MOST
    assert material.level(material.past, -3.0, 3.0) > material.level([], -3.0, 3.0) == 0
    material.run([9.9, -9.9])
    assert material.past == [-10.0, 9.9, -9.9, 0.0]


def test_a_drive_that_the_model_does_not_bear_is_refused_by_the_device(bench):
    box = Device(BenchResponse(bench, {"mean_field": {}}), noise=False)
    box.receive(p.generate_packet(WIDTH, 0, round(0.6 / DRIVE_SCALE), 0, 1.0), 0.0)
    ack = p.read_ack(box.receive(p.start_packet(1, RATE, WIDTH), 0.0)[0])
    assert ack.status and "outside the Preisach plane" in ack.text and not box.running and box.drive_now() == 0


@pytest.mark.long
def test_a_displacement_read_late(bench):
    prompt, late = (play(Device(BenchResponse(bench, {}, shift=s), noise=False), 0.4)[-WIDTH:] for s in (0.0, 5 / RATE))
    assert np.allclose(late[:, 0], prompt[:, 0]) and np.abs(late[:, 1] - np.roll(prompt[:, 1], 5)).max() < 4e-9
