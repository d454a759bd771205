"""Whether what an effect leaves may be the form of its law: where that is a filter of the reading, any other filter is tried."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import fitting.search
from fitting.attribute import Trial
from fitting.demo import record
from fitting.form import filter_takes, free_filter
from fitting.screen import Candidate, Projector, columns
from fitting.search import Reached
from fitting.setup import Choices, build_problem, spectra_of
from magjax.bench import load_bench


@pytest.fixture(scope="module")
def posed():
    """Three sines of a rod, at two amplitudes each, as its own model meets them: (problem, unknowns, lines of the model, their frequencies)."""
    bench, rng = load_bench("aa-050h"), np.random.default_rng(4)
    recordings = [record(bench.actuator(), f, a, 0.1, rng, f"{f:g} Hz {a:g} A") for f in (20.0, 90.0, 300.0) for a in (0.6, 0.3)]
    problem, z = build_problem(spectra_of(recordings, bench), bench.actuator(), bench, ("coil.R_eddy", "mechanics.f0"), Choices(rest="negative"))
    lines = problem.passes.lines(z, problem.predictors[1])
    return problem, z, lines, np.array([s.frequency for s in problem.spectra])[:, None] * np.arange(lines.shape[1])


def measured(posed, lines):
    """As a fit's result, of a model that misses these lines."""
    problem, z, _, _ = posed
    target = eqx.tree_at(lambda t: t.lines, problem.target, jnp.asarray(lines))
    problem = dataclasses.replace(problem, target=target)
    return SimpleNamespace(problem=problem, refined=SimpleNamespace(z=z, weights=np.ones(len(problem.penalties))))


def left(result):
    """What the model cannot make of the misfit, to first order."""
    return float(np.sum(Projector(result.problem, result.refined).residual ** 2))


def test_another_filter_takes_what_the_form_of_a_lag_leaves(posed):
    """Of a Bessel filter a critically damped one of the same delay leaves some thousandths of the reading."""
    *_, lines, f = posed
    s = 2j * np.pi * f * 5e-4
    result = measured(posed, lines * (1 + s / 2) ** 2 / (1 + s + s**2 / 3))
    assert left(result) > 1000
    assert filter_takes(result) > 0.99 * left(result)


@pytest.mark.long
def test_no_filter_takes_what_a_strain_that_lags_behind_m_leaves(posed):
    """Its loop is as wide at 20 Hz as at 300."""
    problem, z, lines, _ = posed
    (column,) = [c for e, shapes, c in columns(problem, z) if e.name == "strain_hysteresis"][:1]
    width, deviations = lines.shape[1], problem.passes.target.deviations
    real, imaginary = column[: 6 * width].reshape(6, width), column[6 * width :].reshape(6, width - 1)
    change = real + 1j * np.pad(imaginary, ((0, 0), (1, 0)))
    change = np.where(np.isfinite(deviations), change * np.where(np.isfinite(deviations), deviations, 0.0), 0.0)
    result = measured(posed, lines + change * 40 / np.linalg.norm(Projector(problem, measured(posed, lines).refined).project(column)))
    assert left(result) == pytest.approx(1600, rel=0.1)
    assert filter_takes(result) < 0.75 * left(result)


def test_a_free_filter_changes_seen_lines_alone(posed):
    """By a gain, real and imaginary, of hats that add up to one."""
    problem, _, lines, f = posed
    every = free_filter(measured(posed, lines))
    half = len(every) // 2
    target = problem.passes.target
    seen = (f > 0) & (np.abs(lines) > target.deviations)
    expected = np.concatenate([x.ravel() for x in ((lines * seen / target.deviations).real, (lines * seen / target.deviations).imag[:, 1:])])
    assert np.allclose(every[:half].sum(axis=0), expected, atol=1e-9 * np.abs(expected).max())
    assert half == len(every) - half > 4


@pytest.mark.parametrize(
    ("first", "left", "takes", "named"),
    [("sensor_lag", 2.7, 500.0, True), ("sensor_lag", 2.7, 1100.0, False), ("duffing_stiffness", 2.7, 500.0, False), ("sensor_lag", 1.25, 50.0, False)],
    ids=["a filter leaves half", "a filter takes it", "no filter was found", "next to the noise"],
)
def test_what_no_filter_makes_is_named_beside_a_strong_lag(monkeypatch, first, left, takes, named):
    """strain_hysteresis beside a Bessel filter that took 634383 of chi2 takes 1117 of 1299 above the noise, where any filter takes 771."""
    monkeypatch.setattr(fitting.search, "filter_takes", lambda result: takes)
    base, current = (SimpleNamespace(chi2_per_sample=x, data_count=729, actuator=load_bench("aa-050h").actuator()) for x in (874.0, left))
    after = SimpleNamespace(chi2_per_sample=1.17, data_count=729, actuator=base.actuator)

    def trial(name, result, of):
        drop = (of.chi2_per_sample - result.chi2_per_sample) * 729
        share = drop / ((of.chi2_per_sample - 0.92) * 729)
        return Trial(Candidate(name, "block", 9.0, 1.0, 1.0, {}, 81.0, 1.0, False), result, drop, 7 - drop, True, share, 1)

    state = Reached(current, [(trial(first, current, base), [], [], base)], {})
    assert fitting.search._makes_up_for_form(state, base, trial("strain_hysteresis", after, current)) is not named
    assert fitting.search._makes_up_for_form(state, base, trial("creep", after, current))  # a filter itself
