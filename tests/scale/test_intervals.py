"""Bootstrap and profile of a fit: the right scatter, the same numbers whoever works, what cannot be done said."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.joint import data_jacobian, prior_matrix
from fitting.model import Target, whitened
from fitting.scale import bootstrap_intervals, profile_intervals
from fitting.scale.bootstrap import block_noise, model_lines, parametric_noise, period_lines
from fitting.scale.profile import full_names, held, walk
from fitting.scale.refit import settle, settle_each, with_lines
from fitting.spectra import Spectrum, gain_rows
from fitting.uncertainty import WIDEN, covariance
from magjax.errors import ConfigurationError


@pytest.fixture(scope="module")
def hundred(result):
    return bootstrap_intervals(result, 100, seed=4)


def sampling_deviations(result):
    """Standard deviation of each parameter over repeated noise, to first order: N^-1 J'J N^-1 on the unknowns inside."""
    problem, z = result.problem, result.refined.z
    J = data_jacobian(problem, z)
    normal = J.T @ J + prior_matrix(problem, result.refined.weights)
    n = problem.layout.density_unknowns
    inside = np.flatnonzero(np.append(z[:n] > 0, np.ones(len(z) - n, bool)))
    inverse = np.linalg.inv(normal[np.ix_(inside, inside)])
    cov = inverse @ (J.T @ J)[np.ix_(inside, inside)] @ inverse
    at = {n: list(inside).index(problem.layout.index(n)) for n in problem.layout.names}
    return {n: problem.layout.slope(n, z) * np.sqrt(cov[k, k]) for n, k in at.items()}


def test_the_scatter_is_that_of_repeated_noise(result, hundred):
    expected = sampling_deviations(result)
    assert hundred.converged.all() and hundred.draws.shape == (100, 3)
    for name in hundred.names:
        assert 0.8 < hundred.deviation(name) / expected[name] < 1.25  # 100 draws: 7 %
        low, high = hundred.interval(name)
        assert low < result.estimate(name).value < high
    # fitted noise has fewer degrees of freedom than data
    assert 0.5 < hundred.chi2.mean() / result.data_count < 1.0


@pytest.mark.long
def test_blocks_scatter_alike(result, hundred):
    blocks = bootstrap_intervals(result, 40, kind="blocks", seed=4)
    ratio = [blocks.deviation(n) / hundred.deviation(n) for n in blocks.names]
    assert 0.5 < np.mean(ratio) < 1.5  # four periods tell their own scatter to a third


@pytest.mark.long
def test_two_processes_give_the_same_draws_and_more_draws_go_on(result, hundred, tmp_path):
    path = tmp_path / "draws"
    twenty = bootstrap_intervals(result, 20, seed=4, executor="processes:2", checkpoint=path)
    assert np.array_equal(twenty.draws, hundred.draws[:20])
    thirty = bootstrap_intervals(result, 30, seed=4, checkpoint=path)
    assert thirty.outcome.resumed == 2 and np.array_equal(thirty.draws, hundred.draws[:30])
    data = thirty.dataset()
    assert data["coil.R_eddy"].attrs["units"] == "ohm" and data.sizes["draw"] == 30
    content = json.loads(json.dumps(thirty.as_dict()))
    assert content["settled"] == 30 and set(content["parameters"]) == set(thirty.names)
    assert "30 draws" in str(thirty)


@pytest.mark.long
def test_settling_from_afar_ends_at_the_optimum(result):
    problem, weights = result.problem, result.refined.weights
    centre = settle(problem, result.refined.z, weights)
    away = centre.z.copy()
    away[problem.layout.index("mechanics.xi")] += 0.02  # thirty standard errors
    back = settle(problem, away, weights)
    assert centre.converged and back.converged
    for name in problem.layout.names:
        k = problem.layout.index(name)
        stderr = result.estimate(name).stderr / problem.layout.slope(name, centre.z)
        assert abs(back.z[k] - centre.z[k]) < 0.1 * stderr
    assert not settle(problem, away, weights, jacobian=0 * centre.jacobian, jacobians=0).converged


def test_refits_side_by_side_are_those_one_by_one(result):
    problem, weights, rng = result.problem, result.refined.weights, np.random.default_rng(8)
    centre = settle(problem, result.refined.z, weights)
    lines = model_lines(problem, centre.z) + np.stack([parametric_noise(problem.target, rng) for _ in range(12)])
    found = settle_each(problem, lines, centre.z, weights, centre.jacobian)
    alone = [settle(with_lines(problem, row), centre.z, weights, jacobian=centre.jacobian) for row in lines]
    scatter = np.std([s.z for s in alone], axis=0) + 1e-12
    for one, other in zip(found, alone, strict=True):
        assert one.converged and other.converged and one.chi2 == pytest.approx(other.chi2, rel=1e-9)
        assert np.abs((one.z - other.z) / scatter).max() < 1e-6
    # a draw's numbers do not depend on how many there are, nor on its neighbours
    few = settle_each(problem, lines[:3], centre.z, weights, centre.jacobian)
    assert all(np.array_equal(a.z, b.z) for a, b in zip(few, found, strict=False))
    # where the Jacobian does not serve, a draw takes its own
    (lost,) = settle_each(problem, lines[:1], centre.z, weights, -centre.jacobian)
    assert lost.converged and lost.jacobians and lost.chi2 == pytest.approx(alone[0].chi2, rel=1e-3)


@pytest.mark.long
def test_lines_of_each_on_several_grids(result):
    """Two grids whose recordings stand in another order among all, and levels of their own."""
    one, problem = result.problem.predictors[1], result.problem
    drive, dt = one.drives[0], one.steps[0]
    two = dataclasses.replace(one, drives=(drive[:2], drive[2:, ::2]), steps=(dt[:2], 2 * dt[2:]), index=(1, 2, 0), periods=2 * one.periods)
    z = jnp.asarray(np.stack([result.refined.z, 1.01 * result.refined.z]))
    levels = jnp.asarray([[300.0, -200.0, 100.0], [0.0, 50.0, -400.0]])
    actuators = [problem.layout.actuator(problem.template, row) for row in z]
    found = eqx.filter_jit(two.lines_of_each)(jax.vmap(lambda row: problem.layout.actuator(problem.template, row))(z), levels)
    alone = eqx.filter_jit(two.__call__)
    expected = np.stack([alone(a, own) for a, own in zip(actuators, levels, strict=True)])
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def target(scales=0.01):
    """A made-up target of three recordings with uncertain scales and an unmeasured mean."""
    rng = np.random.default_rng(0)
    lines = 1e-6 * (rng.standard_normal((3, 6)) + 1j * rng.standard_normal((3, 6)))
    lines[:, 0] = lines[:, 0].real
    deviations = np.full((3, 6), 1e-8)
    deviations[1, 0] = np.inf
    spectra = [dataclasses.replace(spectrum(), reading=row, gain_accuracy=scales) for row in lines]
    rows, shares = gain_rows(spectra, deviations)
    blank = jnp.zeros(1)
    return Target(jnp.asarray(lines), jnp.asarray(deviations), blank, blank, blank, jnp.asarray(rows), jnp.asarray(shares))


def spectrum(periods=40, samples=4000, noise=0.3):
    rng = np.random.default_rng(5)
    residue = noise * rng.standard_normal(samples)
    blank = np.zeros(6, complex)
    return Spectrum("made up", 50.0, periods, samples, 2e-4, blank, blank, np.zeros(0), np.zeros(0), residue, 1.0, 0.0)


def test_parametric_noise_is_white_once_whitened():
    t, rng = target(), np.random.default_rng(1)
    misfits = np.stack([np.asarray(whitened(t.lines + parametric_noise(t, rng), t)) for _ in range(4000)])
    cov = misfits.T @ misfits / 4000
    expected = np.ones(misfits.shape[1])
    expected[6] = 0.0  # the mean that is not measured
    assert np.abs(cov - np.diag(expected)).max() < 6 / np.sqrt(4000)
    # without uncertain scales their share would be missing: the two kinds of noise differ
    plain, rng = target(0.0), np.random.default_rng(1)
    assert np.std([parametric_noise(plain, rng)[2, 1].real for _ in range(300)]) < 1.2e-8


def test_model_lines_undo_the_whitening(result):
    problem = result.problem
    lines = model_lines(problem, result.refined.z)
    residual = np.asarray(whitened(jnp.asarray(lines), problem.target))
    from fitting.joint import data_residual

    assert residual == pytest.approx(data_residual(problem, result.refined.z), abs=1e-6)
    assert np.abs(data_residual(with_lines(problem, lines), result.refined.z)).max() < 1e-6


@pytest.mark.parametrize("periods", [4, 40])
def test_block_noise_has_the_variance_of_the_mean(periods):
    """The mean over all periods of white noise: each part of a line has variance noise^2 / (2 samples)."""
    rng, samples = np.random.default_rng(2), 100 * periods
    found = []
    for k in range(60 if periods == 4 else 12):  # few periods know their own scatter badly
        made = dataclasses.replace(spectrum(periods, samples), residue=0.3 * np.random.default_rng(k).standard_normal(samples))
        lines = period_lines(made, 6)
        found.append(np.mean([np.abs(block_noise([lines], rng)[0, 1:]) ** 2 for _ in range(200)]))
    assert np.mean(found) == pytest.approx(0.3**2 / samples, rel=0.15)
    assert block_noise([period_lines(spectrum(), 6)], rng)[0, 0].imag == 0


def test_too_few_periods_for_blocks(result):
    few = dataclasses.replace(result.problem.spectra[0], periods=2)
    poor = dataclasses.replace(result, problem=dataclasses.replace(result.problem, spectra=(few,)))
    with pytest.raises(ConfigurationError, match="parametric"):
        bootstrap_intervals(poor, 10, kind="blocks")
    for wrong in ({"count": 1}, {"kind": "wild"}, {"level": 0.1}):
        with pytest.raises(ConfigurationError, match="give 2 draws"):
            bootstrap_intervals(result, **{"count": 10, **wrong})


def test_profile_agrees_with_the_standard_error_where_it_is_quadratic(result):
    found = profile_intervals(result)
    layout, z = result.problem.layout, result.refined.z
    variances = np.diag(covariance(result.refined.normal, z, layout))
    for name in found.names:
        low, high = found.interval(name)
        deviation = abs(layout.slope(name, z)) * np.sqrt(variances[layout.index(name)])
        assert (high - low) / 2 == pytest.approx(1.96 * deviation, rel=0.2)
        # the density is kept from being negative here; half of what that does to the estimate is among its stated errors
        half = result.estimate(name).value - float(layout.value(name, z))
        assert result.estimate(name).stderr == pytest.approx(WIDEN * np.hypot(deviation, half), rel=0.01)
        assert low < result.estimate(name).value < high
        assert all(e.found and e.note == "" for e in found.ends[name])
        # the ends lie where the profile has risen by the quantile
        for end in found.ends[name]:
            assert end.points[-1] == (end.value, pytest.approx(3.84, rel=0.05))
    assert json.loads(json.dumps(found.as_dict()))["parameters"]["mechanics.xi"]["high_found"]
    narrow = profile_intervals(result, ["xi"], level=0.68)
    assert narrow.names == ("mechanics.xi",) and "68 %" in str(narrow)
    assert np.ptp(narrow.interval("mechanics.xi")) < 0.6 * np.ptp(found.interval("mechanics.xi"))


def test_a_profile_goes_on_from_its_checkpoint(result, tmp_path):
    whole = profile_intervals(result, ["xi"], checkpoint=tmp_path / "kept")
    lines = (tmp_path / "kept").read_bytes().splitlines(keepends=True)
    (tmp_path / "kept").write_bytes(b"".join(lines[:2]) + lines[2][:40])
    again = profile_intervals(result, ["xi"], checkpoint=tmp_path / "kept")
    assert again.outcome.resumed == 1 and again.as_dict() == whole.as_dict()


def test_a_held_parameter_stays(result):
    problem = result.problem
    index = problem.layout.index("mechanics.f0")
    z = result.refined.z.copy()
    coordinate = z[index] + 0.001
    pinned = held(problem, "mechanics.f0", coordinate, 1e8)
    z[index] = 0.0
    found = settle(pinned, z, result.refined.weights)
    value = float(pinned.layout.value("mechanics.f0", jnp.asarray(found.z)))
    wanted = result.refined.z.copy()
    wanted[index] = coordinate
    assert value == pytest.approx(float(problem.layout.value("mechanics.f0", jnp.asarray(wanted))), rel=1e-9)


def test_a_bound_ends_the_walk(result):
    problem, weights = result.problem, result.refined.weights
    centre = settle(problem, result.refined.z, weights)
    xi, stderr = (float(getattr(result.estimate("mechanics.xi"), k)) for k in ("value", "stderr"))
    slope = problem.layout.slope("mechanics.xi", centre.z)
    inputs = {
        "problem": problem, "z": centre.z, "weights": weights, "jacobian": centre.jacobian, "cost": centre.cost, "level": 0.95,
        "bounds": {"mechanics.xi": (0.0, xi + 0.4 * stderr)}, "deviations": {"mechanics.xi": stderr / WIDEN / slope},
    }  # fmt: skip
    end = walk(inputs, ("mechanics.xi", 1), None)
    assert not end["found"] and "bound" in end["note"] and end["value"] == pytest.approx(xi + 0.4 * stderr, rel=1e-6)
    assert walk(inputs, ("mechanics.xi", -1), None)["found"]


def test_names_of_a_profile(result):
    names = ("coil.R_eddy", "mechanics.xi", "effects.a.tau", "effects.b.tau")
    assert full_names(["xi", "coil.R_eddy", "xi"], names) == ("mechanics.xi", "coil.R_eddy")
    with pytest.raises(ConfigurationError, match="effects.a.tau or effects.b.tau"):
        full_names(["tau"], names)
    with pytest.raises(ConfigurationError, match="not free"):
        profile_intervals(result, ["lambda_s"])
