"""The summaries of a residual on signals whose answer is known."""

import re
import types

import numpy as np
import pytest

from fitting.fit import RESTS
from fitting.report.misfit import STAGES, convergence, stages_of
from fitting.report.residuals import autocorrelation, by_field_and_rate, by_phase, traces


def spectrum(frequency=50.0, periods=4, per=1000, rng=None):
    rng = rng or np.random.default_rng(0)
    samples = periods * per
    return types.SimpleNamespace(
        frequency=frequency,
        periods=periods,
        samples=samples,
        dt=1 / (frequency * per),
        residue=rng.standard_normal(samples),
        noise_rms=1.0,
    )


def test_autocorrelation_of_white_noise_stays_in_its_band():
    rng = np.random.default_rng(5)
    spectra = [spectrum(f, rng=rng) for f in (10.0, 50.0, 200.0)]
    found = autocorrelation(spectra, [s.residue for s in spectra])
    outside = np.mean(np.abs(found["residual"]) > found["band"])
    assert outside < 0.12 and found["lag"][-1] == pytest.approx(2.0)
    assert np.array_equal(found["residual"], found["noise"])


def test_autocorrelation_sees_what_repeats():
    s = spectrum()
    phase = np.arange(s.samples) * s.dt * s.frequency
    found = autocorrelation([s], [s.residue + np.sin(2 * np.pi * phase)])
    at = np.argmin(np.abs(found["lag"] - 1.0))
    assert found["residual"][at] == pytest.approx(1 / 3, abs=0.06)  # power of the sine over all power
    assert found["residual"][np.argmin(np.abs(found["lag"] - 0.5))] == pytest.approx(-1 / 3, abs=0.06)


def test_traces_have_unit_variance_where_the_noise_is_white():
    s = spectrum(per=5000)
    value = traces([s], [s.residue])["0"]["value"]
    assert np.std(value) == pytest.approx(1.0, abs=0.2)


def test_branches_are_told_apart():
    s = spectrum()
    phase = np.arange(s.samples) * s.dt * s.frequency
    applied = 1e4 * np.sin(2 * np.pi * phase)
    rising = np.cos(2 * np.pi * phase) > 0
    found = by_field_and_rate([s], [applied], [np.where(rising, 0.5, -0.5) + 0.01 * s.residue])
    for key in ("field", "rate"):
        up, down = found[key]["rising"], found[key]["falling"]
        middle = slice(2, -2)
        assert np.nanmax(np.abs(up[0, middle] - 0.5)) < 0.1 and np.nanmax(np.abs(down[0, middle] + 0.5)) < 0.1
        assert np.nanmax(up[1]) < 0.1


def test_folding_keeps_the_phase():
    s = spectrum(per=997)  # does not divide the bins
    phase = np.arange(s.samples) * s.dt * s.frequency
    at, mean, count = by_phase(s, np.sin(2 * np.pi * phase), 200)
    assert count.sum() == s.samples and np.abs(mean - np.sin(2 * np.pi * at)).max() < 1e-3


def test_the_history_is_cut_into_stages():
    steps = [
        ("fit from negative", 1, 9.0),
        ("fit from negative", 2, 3.0),
        ("fit from positive", 1, 8.0),
        ("finer density", 1, 4.0),
        ("finer density", 1, 2.0),
        ("trying creep", 0, None),
        ("finer density", 2, 1.0),
    ]
    assert stages_of(steps) == [
        ("from negative saturation", [9.0, 3.0]),
        ("from positive saturation", [8.0]),
        ("finer density", [4.0]),
        ("finer density (2)", [2.0, 1.0]),
    ]
    assert "from positive saturation" in convergence(steps).svg


def test_every_start_memory_has_a_name():
    assert {f"fit from {rest}" for rests in RESTS.values() for rest in rests} == set(STAGES)


def test_a_convergence_panel_counts_each_stage_by_itself_and_keeps_its_legend_off_the_data():
    steps = [(f"fit from {rest}", k, 9.0 / k) for rests in RESTS.values() for rest in rests[:1] for k in range(1, 8)]
    svg = convergence(steps).svg
    ticks = [int(x) for x in re.findall(r"anchor: middle[^>]*>(\d+)<", svg)]
    assert ticks == list(range(1, 8))
    (legend,) = re.findall(r'x="([\d.]+)"[^>]*>from negative saturation<', svg)
    assert float(legend) > 0.72 * 720  # where the axes end, points
