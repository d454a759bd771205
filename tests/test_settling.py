"""As many periods as it takes: a rod that lags by more than a period is fitted settled."""

import dataclasses
import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.check import check_errors
from fitting.demo import record
from fitting.fit import fit
from fitting.settling import LADDER, periods_asked
from fitting.setup import Choices
from magjax.bench import load_bench


def problem(magnetizations, periods):
    return SimpleNamespace(predictors=[SimpleNamespace(periods=periods)], passes=SimpleNamespace(magnetizations=lambda z: magnetizations))


@pytest.mark.parametrize(("periods", "left", "asked"), [
    (3, 1e-4, 3), (3, 1e-3, 6), (5, 1e-3, 6), (6, 1e-3, 12), (12, 1e-3, 24), (24, 1e-3, 24), (40, 1e-3, 40), (2, 1e-4, 2),
])  # fmt: skip
def test_the_next_number_of_periods_where_one_recording_does_not_repeat(periods, left, asked):
    loop = np.sin(2 * np.pi * np.arange(50) / 50)
    still = np.tile(loop, (periods, 1))
    moving = still + 2 * left * (periods - 1 - np.arange(periods))[:, None]
    assert periods_asked(problem([still, moving], periods), None) == asked


def test_a_rod_that_lags_by_more_than_a_period(monkeypatch):
    """4 ohm: after three periods M still moves at 300 Hz, and no density makes up for it."""
    bench, rng = load_bench("aa-050h"), np.random.default_rng(5)
    truth = bench.actuator().replace({"coil.R_eddy": 4.0})
    drives = ((20.0, 0.8, 0.1), (120.0, 0.7, 0.0), (300.0, 0.5, 0.3))
    recordings = [record(truth, *drive, rng, f"{drive[0]:g} Hz") for drive in drives]
    near = dataclasses.replace(bench, constants={**bench.constants, "coil.R_eddy": 5.0})
    found = fit(recordings, near, choices=Choices(fine=250), refine=False)
    assert found.choices.periods in LADDER[1:] and found.chi2_per_sample < 1.2
    resistance = found.estimate("coil.R_eddy")
    assert abs(resistance.value - 4.0) < 3 * resistance.stderr + 0.02
    row = check_errors(found.actuator, found.actuator, [record(truth, *drives[2], rng, "check")], bench)[0]
    assert row["rms_after"] < 2.5 * row["noise_rms"]
    monkeypatch.setattr(importlib.import_module("fitting.fit"), "periods_asked", lambda problem, z: problem.predictors[0].periods)
    assert fit(recordings, near, choices=Choices(fine=250), refine=False).chi2_per_sample > 1.5 * found.chi2_per_sample
