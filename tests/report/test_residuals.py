"""The summaries of a residual on signals whose answer is known."""

import re
import types

import numpy as np
import pytest

from fitting.memories import RESTS
from fitting.report.misfit import STAGES, against, convergence, misfit_map, row_labels, stages_of
from fitting.report.misfit import autocorrelation as drawn_autocorrelation
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


def lines_of(ratio, frequencies):
    """Evidence of recordings whose every line is met to `ratio` times its noise."""
    return {
        "frequency": np.array(frequencies), "name": np.array([f"rec_{k}.csv" for k in range(len(frequencies))]),
        "lines": {"misfit": np.full((len(frequencies), 5), float(ratio)), "floor": np.ones((len(frequencies), 5))},
    }  # fmt: skip


def test_rows_of_one_frequency_are_told_apart_by_their_files():
    assert row_labels(lines_of(1.0, [24.0, 8.0, 24.0]), [1, 0, 2]) == ["8 Hz", "rec_0.csv, 24 Hz", "rec_2.csv, 24 Hz"]


def test_maps_before_and_after_have_the_same_colours():
    before, after = lines_of(300.0, [8.0]), lines_of(2.0, [8.0])
    ticks = [re.findall(r">([\d.]+)</text>", misfit_map(e, beside=b).svg)[-4:] for e, b in ((before, after), (after, before), (after, None))]  # fmt: skip
    assert ticks[0] == ticks[1] != ticks[2]


def test_the_autocorrelation_of_noise_is_no_alarm():
    found = {"lag": np.arange(1, 11) / 10, "band": np.array(0.1), "residual": np.array([0.2] * 4 + [0.0] * 6), "noise": np.array([0.2] * 5 + [0.0] * 5)}  # fmt: skip
    caption = drawn_autocorrelation({"autocorrelation": found}).caption
    assert "lie 40 % of the lags of the residual, and 50 % of those of the noise alone" in caption


def test_means_are_drawn_to_their_own_scale():
    rows = np.array([np.full(8, 0.1), np.full(8, 0.02), np.full(8, -1.6), np.full(8, 1.6)])
    branch = {"rising": rows, "falling": rows}
    evidence = lines_of(1.0, [8.0, 20.0]) | {
        "chi2": np.array([1.0, 1.1]),
        "against": {"field": {"edges": np.linspace(0, 1e4, 9), **branch}, "rate": {"edges": np.geomspace(1, 1e4, 9), **branch}},
    }
    picture = against(evidence)
    assert "90 % lie within ± 1.6" in picture.caption and ">1.5</text>" not in picture.svg and ">0.10</text>" in picture.svg
