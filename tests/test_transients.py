"""Records that begin unsettled: the decaying motion is found and taken out, nothing is where there is none."""

import dataclasses

import numpy as np
import pytest

from fitting.demo import concealed_actuator, record
from fitting.fit import fit
from fitting.floors import data_problem
from fitting.setup import Choices, spectra_of
from fitting.spectra import reduce_recording
from fitting.transients import free_motion, unsettled_starts
from magjax.bench import load_bench
from magjax.recording import Recording

POLES = (405.0, 0.81)
NOISE = 41e-9


def motion(dt, count):
    """A start of 1 m that has not settled."""
    return np.array([1.0, -0.5]) @ free_motion(*POLES, dt, count)


def spectra(amplitude=0.0, slow=0.0, drift=0.0):
    """Nine sines with noise, a decaying start, a slower decay and a drift, reduced."""
    rng, found = np.random.default_rng(3), []
    for f in (10, 25, 50, 80, 120, 160, 200, 250, 300):
        t = np.arange(4000) / (1000 * f)
        drive = np.sin(2 * np.pi * f * t)
        y = 2e-5 * (drive + 0.3 * drive**3) + NOISE * rng.standard_normal(4000) + amplitude * motion(t[1], 4000)
        y = y + slow * np.exp(-t / 0.02) + drift * t / t[-1]
        found.append(reduce_recording(Recording(t, {"current": drive, "displacement": y}, name=str(f)), "current", "displacement"))
    return found


@pytest.mark.parametrize("xi", [0.05, 0.81, 1.0, 1.3])
def test_free_motion_solves_the_equation_without_drive(xi):
    dt = 1e-6
    w0 = 2 * np.pi * 300
    for y, start in zip(free_motion(300.0, xi, dt, 20000), ((1.0, -xi * w0), (0.0, w0)), strict=True):
        rate = np.gradient(y, dt)
        assert y[0] == pytest.approx(start[0]) and (y[1] - y[0]) / dt == pytest.approx(start[1], abs=5e-3 * w0)
        left = np.gradient(rate, dt) + 2 * xi * w0 * rate + w0**2 * y
        assert np.abs(left[5:-5]).max() < 3e-3 * w0**2


def test_an_unsettled_start_is_found_to_the_noise():
    for s, start in zip(made := spectra(1e-6), unsettled_starts(made, 392.0), strict=True):
        assert start is not None and np.abs(start - 1e-6 * motion(s.dt, s.samples)).max() < NOISE


@pytest.mark.parametrize("other", [{}, {"slow": 1e-6}, {"slow": 1e-5}, {"drift": 1e-6}, {"drift": 1e-5}])
def test_nothing_is_taken_out_where_nothing_of_the_kind_is(other):
    assert unsettled_starts(spectra(**other), 392.0) == [None] * 9


@pytest.mark.long
def test_a_fit_of_unsettled_records_reaches_the_noise():
    bench = load_bench("aa-050h")
    truth, rng = concealed_actuator(bench), np.random.default_rng(7)
    recordings = []
    for drive in ((10, 0.8, 0.1), (50, 0.5, -0.2), (150, 0.8, 0.1), (300, 0.5, 0.0)):
        run = record(truth, *drive, rng, str(drive[0]))
        reading = run.channels["displacement"]
        reading = reading + 1e-6 * motion(run.dt, len(reading))
        recordings.append(dataclasses.replace(run, channels={**run.channels, "displacement": reading}))
    assert data_problem(recordings, spectra_of(recordings, bench), "displacement") is None
    got = fit(recordings, bench, choices=Choices(fine=250), refine=False)
    assert got.chi2_per_sample < 1.05  # 1.10 with the start left in, and errors that are twelve times as large
    for name, value in (("coil.R_eddy", 62.0), ("mechanics.xi", 0.81), ("mechanics.f0", 405.0)):
        estimate = got.estimate(name)
        assert abs(estimate.value - value) < 3 * estimate.stderr and estimate.stderr < 2.5e-3 * value
    assert "4 of 4 recordings began unsettled" in got.message
