"""The joint fit on an invented bench: the noise reached, the constants within their errors, determinism, outcomes."""

import dataclasses
import importlib
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
from scipy.sparse import csc_array

import magjax.bench
from fitting import solver
from fitting.check import check_errors
from fitting.demo import concealed_actuator, record
from fitting.density import DensityBasis, cell_basis, everett_values, hat_basis
from fitting.experiments import _predicted
from fitting.finer import CELLS, FINER, cells_beside, finer_hats, finer_than, in_words
from fitting.fit import finish, fit
from fitting.joint import data_residual
from fitting.outcome import beyond_the_rod, guessed, loose, valleys
from fitting.recipe import recipe_beside
from fitting.screen import screened
from fitting.setup import Choices, build_problem, free_parameters, spectra_of
from fitting.solver import ProjectedLevenbergMarquardt, SteppedLevenbergMarquardt, bounded_minimum, led_back
from fitting.spectra import estimate_noise, fit_lines, reduce_recording, with_noise
from fitting.starts import agreeing, equation_error_start, operator_rows, unfold
from fitting.steps import stepped
from fitting.uncertainty import widened
from magjax.bench import load_bench
from magjax.effects import SensorNonlinearity
from magjax.errors import ConfigurationError, RecordingError
from magjax.preisach import Preisach, density_masses
from magjax.recording import Recording, whole_periods
from magjax.simulate import simulate
from tests.studies.joint_fit import NAMES, SINES, TRUTH, one_draw, settled

TRUE = {"coil.R_eddy": 62.0, "mechanics.xi": 0.81, "mechanics.f0": 405.0}
fitting_fit = importlib.import_module("fitting.fit")  # not the function
QUICK = Choices(fine=250)


@pytest.fixture(scope="module")
def bench():
    return load_bench("aa-050h")


@pytest.fixture(scope="module")
def recordings(bench):
    rng = np.random.default_rng(7)
    truth = concealed_actuator(bench)
    return [
        record(truth, *drive, rng, f"r{drive[0]}") for drive in ((10, 0.8, 0.1), (50, 0.5, -0.2), (150, 0.8, 0.1), (300, 0.5, 0.0))
    ]


@pytest.fixture(scope="module")
def result(recordings, bench):
    start = bench.actuator().replace({"coil.R_eddy": 40.0, "mechanics.xi": 0.5, "mechanics.f0": 500.0})
    return fit(recordings, bench, actuator=start, choices=QUICK)


def test_reaches_the_noise_and_the_constants(result):
    assert result.converged and result.chi2_per_sample < 1.2
    for name, true in TRUE.items():
        estimate = result.estimate(name)
        assert abs(estimate.value - true) < 3.5 * estimate.stderr
        assert abs(estimate.value / true - 1) < 0.01
    assert "noise" in result.message
    assert "coil.R_eddy" in str(result)


def test_a_recording_of_few_samples_a_period_leaves_the_others_their_harmonics(recordings, bench):
    """Ten samples a period bear four harmonics; those of the others were cut to four as well."""
    per = round(recordings[3].period_samples())
    rows = slice(None, None, per // 10)
    few = dataclasses.replace(
        recordings[3], time=recordings[3].time[rows], channels={q: v[rows] for q, v in recordings[3].channels.items()}
    )
    spectra = spectra_of([*recordings[:3], few], bench)
    problem, z = build_problem(spectra, bench.actuator(), bench, free_parameters(bench, bench.actuator()), Choices(rest="negative"))
    bare = len(spectra[3].reading)
    assert bare == 5 and problem.data_count == 3 * 81 + 2 * bare - 1
    residual = data_residual(problem, z).reshape(-1)
    real = residual[: 4 * 41].reshape(4, 41)
    assert np.all(np.isfinite(residual)) and not real[3, bare:].any() and real[0, bare:].any()


@pytest.mark.parametrize("start", [0.001, 0.1])
def test_a_prior_of_a_law_is_about_its_null_wherever_a_fit_begins(recordings, bench, start):
    actuator = bench.actuator().with_effect(SensorNonlinearity(q=start))
    names, spectra = free_parameters(bench, actuator, ("effects.sensor_nonlinearity.q",)), spectra_of(recordings[:2], bench)
    problem, z = build_problem(spectra, actuator, bench, names, Choices(rest="negative"))
    k, stated = problem.layout.index("effects.sensor_nonlinearity.q"), dataclasses.replace(bench, priors={"effects.sensor_nonlinearity.q": 0.5})
    charged = np.asarray(problem.target.priors) * z[problem.layout.density_unknowns + 1 :]
    assert charged[k - problem.layout.density_unknowns - 1] == pytest.approx(start / 0.02) and np.count_nonzero(charged) == 1
    assert float(problem.layout.value("effects.sensor_nonlinearity.q", jnp.asarray(z))) == pytest.approx(start)
    problem, z = build_problem(spectra, actuator, stated, names, Choices(rest="negative"))  # the bench's word comes first
    assert z[k] == 0 and float(problem.target.priors[k - problem.layout.density_unknowns - 1]) == pytest.approx(0.01 / 0.5)

ONE_GRID = SimpleNamespace(stride=1)


@pytest.mark.parametrize(("stroke", "frequency", "told"), [(6e-5, 10.0, False), (9e-5, 10.0, True), (9e-5, 300.0, False)])
def test_a_reading_beyond_the_rod_is_told(bench, stroke, frequency, told):
    """1.5 times too large a reading was met to its noise, with R_eddy 76 for 62; near its resonance a rod may move further."""
    said = beyond_the_rod([SimpleNamespace(peak_to_peak=stroke, frequency=frequency)], bench.actuator(), bench)
    assert ("scale or unit in [columns.displacement]" in said) == told


@pytest.mark.long
def test_a_density_of_blocks_is_met_by_finer_hats():
    """Blocks of masses that differ tenfold leave chi2/N of 50 on the first hats, which passed for physics, and 4 on the next."""
    bench, rng = load_bench("aa-050h"), np.random.default_rng(0)
    truth, block = concealed_actuator(bench), np.random.default_rng(0)
    masses = np.asarray(truth.hysteresis.masses)
    edges = np.sort(block.choice(np.arange(10, 150), 7, replace=False))
    place = np.searchsorted(edges, np.arange(len(masses)), side="right")
    blocks = masses * np.exp(2 * block.standard_normal((8, 8)))[np.ix_(place, place)]
    plane = Preisach(blocks * masses.sum() / blocks.sum(), truth.hysteresis.low, truth.hysteresis.high, truth.hysteresis.offset)
    truth = dataclasses.replace(truth, hysteresis=plane)
    drives = (10, 0.8, 0.1), (20, 0.5, -0.2), (50, 0.8, 0.1), (80, 0.5, -0.2), (120, 0.8, 0.1)
    result = fit([record(truth, *drive, rng, f"{drive[0]} Hz") for drive in drives], bench, refine=100.0)
    assert result.choices.knots >= (36, 24) and result.chi2_per_sample < 2
    assert result.estimate("coil.R_eddy").value == pytest.approx(62.0, rel=0.005)


def with_random_cells(bench):
    """An actuator whose density has steps: 40 cells along the plane, each with a random mass of its own."""
    low, high, rng = -1200.0, 27000.0, np.random.default_rng(1)
    smooth = concealed_actuator(bench)
    M_s = float(smooth.magnetostriction.M_s)
    lognormal = lambda r: np.exp(-0.5 * (np.log(np.maximum(r, 1e-9) / 2500) / 0.6) ** 2) / np.maximum(r, 1.0)
    even = density_masses(lambda s, r: lognormal(r) * (1 + (s / 9000) ** 2) ** -2, 40, low, high, 0.33 * M_s, refine=4)
    masses = even * rng.lognormal(0, 0.35, even.shape)
    return dataclasses.replace(smooth, hysteresis=Preisach(masses, low, high, 0.57 * M_s))


def with_steps(runs, bench):
    """Fits on hats of 36 x 24 of recordings, without and with steps of the density where these serve."""
    even = fit(runs, bench, choices=dataclasses.replace(QUICK, knots=(36, 24)), refine=False)
    problem, solution = stepped(even.problem, even.solution)
    return even, finish(problem, solution, dataclasses.replace(even.choices, stiffness=problem.stiffness), bench, runs)


def on_random_cells(bench):
    """Recordings of a bench whose density is random cells, and one to check."""
    truth, rng = with_random_cells(bench), np.random.default_rng(3)
    drives = (10, 0.8, 0.1), (50, 0.5, -0.2), (150, 0.8, 0.1), (300, 0.5, 0.0)
    return [record(truth, *d, rng, f"{d[0]}") for d in drives], record(truth, 30, 0.65, 0.0, rng, "check")


def test_a_density_with_steps_is_met_and_foretells(bench):
    """What random cells leave under one roughness weight a family passes for physics; Student's law leaves little of it."""
    runs, check = on_random_cells(bench)
    even, steps = with_steps(runs, bench)
    (row,) = check_errors(even.actuator, steps.actuator, [check], bench)
    assert steps.problem.stiffness.fits(steps.problem.basis) and steps.unknowns < even.unknowns
    assert even.chi2_per_sample > 1.3 and steps.chi2_per_sample - 0.95 < 0.5 * (even.chi2_per_sample - 0.95)
    assert row["rms_after"] < row["rms_before"]


@pytest.mark.long
def test_cells_that_were_chosen_get_steps(bench, monkeypatch):
    """One roughness weight a family is as wrong of cells as of hats."""
    monkeypatch.setattr("fitting.finer.FINER", ((), CELLS[:1], ()))
    monkeypatch.setattr(fitting_fit, "CELLS_MEET", 3.0)
    runs, _ = on_random_cells(bench)
    found = fit(runs, bench, choices=QUICK)
    monkeypatch.setattr(fitting_fit, "STEPS_FROM", np.inf)
    even = fit(runs, bench, choices=QUICK)
    assert found.choices.cells == even.choices.cells == 30 and even.choices.stiffness is None
    assert found.choices.stiffness.fits(found.problem.basis) and in_words(found.choices).endswith("a roughness weight for each of their differences")
    assert found.chi2_per_sample < even.chi2_per_sample - 0.05, (found.chi2_per_sample, even.chi2_per_sample)


def test_what_a_density_is_made_of_is_told(result):
    assert result.as_dict()["density"] == "hats on 18 x 13 knots"
    finer = dataclasses.replace(result.choices, knots=(26, 18), stiffness=object())
    assert in_words(finer) == "hats on 26 x 18 knots, a roughness weight for each of their differences"
    assert in_words(Choices(knots=None, cells=30)).startswith("masses of cells, 30 ") and "held" in in_words(Choices(knots=None, rest="held"))


@pytest.mark.long
def test_what_physics_leaves_no_steps_take(bench, recordings):
    """Of a reading that lags no density makes anything, rough or not."""
    late = [dataclasses.replace(r, channels={**r.channels, "displacement": lagging(r)}) for r in recordings]
    steps, found = with_steps(late, bench)[1], fit(late, bench, choices=QUICK)
    assert found.chi2_per_sample > 1.3 and steps.chi2_per_sample > found.chi2_per_sample - 0.1
    assert found.choices.stiffness is None


def lagging(recording):
    """The reading through a lag of 40 us."""
    y = recording.channels["displacement"]
    turns = 2j * np.pi * np.fft.rfftfreq(len(y), recording.dt)
    return np.fft.irfft(np.fft.rfft(y) / (1 + 4e-5 * turns), len(y))


def test_finer_densities_are_tried_in_steps(bench):
    hats, rough, finest = finer_than(Choices(), bench)
    assert [c.knots for c in hats] == [(26, 18)] and [(c.knots, c.cells) for c in rough[1:]] == [(None, 30), (None, 40)]
    assert finer_than(hats[0], bench) == ((), rough, finest) and finer_than(rough[1], bench) == ((), (), ())
    assert rough[0].knots == (36, 24) and finer_than(rough[0], bench) == ((), (), finest) and finest[0].knots == (48, 32)
    assert (
        cells_beside(hats[0]) == rough[1:]
        and finer_hats(hats[0]) == rough[:1]
        and finer_hats(finest[0]) == cells_beside(rough[1]) == ()
    )
    assert [c.knots for c in finer_than(Choices(), load_bench("rod-eddy"))[1]] == [(36, 24)]


@pytest.mark.long
def test_a_density_of_random_cells_is_fitted_with_steps_or_by_masses_of_cells(bench):
    truth, rng = with_random_cells(bench), np.random.default_rng(3)
    runs = [record(truth, *d, rng, f"{d[0]}") for d in ((10, 0.8, 0.1), (50, 0.5, -0.2), (120, 0.6, 0.1), (300, 0.7, 0.1))]
    even, found = (fit(runs, bench, choices=QUICK, refine=refine) for refine in (False, True))
    assert even.chi2_per_sample > 2 and (found.choices.knots is None or found.choices.stiffness is not None)
    assert found.chi2_per_sample - 0.95 < 0.3 * (even.chi2_per_sample - 0.95)


def test_is_deterministic(recordings, bench, result):
    start = bench.actuator().replace({"coil.R_eddy": 40.0, "mechanics.xi": 0.5, "mechanics.f0": 500.0})
    again = fit(recordings, bench, actuator=start, choices=QUICK)
    assert np.array_equal(again.solution.z, result.solution.z)


def test_an_unsettled_fit_says_so(recordings, bench):
    poor = fit(recordings, bench, choices=dataclasses.replace(QUICK, max_jacobians=2), refine=False)
    assert not poor.converged
    assert "before it settled" in poor.message


def test_interrupt_keeps_what_was_reached(recordings, bench):
    def stop(text, step, chi2):
        if step == 3:
            raise KeyboardInterrupt

    stopped = fit(recordings, bench, choices=QUICK, progress=stop, refine=False)
    assert not stopped.converged and stopped.jacobians == 3
    assert np.isfinite(stopped.chi2_per_sample) and "interrupted after 3" in stopped.message


def test_masses_that_are_not_free_are_held(recordings, bench, result):
    held = dataclasses.replace(bench, free=("coil.R_eddy", "mechanics.xi", "mechanics.f0"))
    with pytest.raises(ConfigurationError, match="--model"):
        fit(recordings, held)
    off = result.actuator.replace({"coil.R_eddy": 80.0, "mechanics.xi": 0.6})
    again = fit(recordings, held, actuator=off, choices=QUICK)
    assert again.converged and again.chi2_per_sample < 1.1 * result.chi2_per_sample
    assert np.array_equal(again.actuator.hysteresis.masses, result.actuator.hysteresis.masses)
    for name in held.free:
        assert again.estimate(name).value == pytest.approx(result.estimate(name).value, rel=3e-3)
        assert again.estimate(name).stderr < 1.05 * result.estimate(name).stderr  # less is unknown
    beyond = dataclasses.replace(
        recordings[0], channels={**recordings[0].channels, "current": 2 * recordings[0].channels["current"]}
    )
    with pytest.raises(ConfigurationError, match="recordings reach"):
        fit([beyond], held, actuator=off)


@pytest.mark.long
def test_a_positive_parameter_stays_within_thirty_times_of_the_bench(recordings, bench, result):
    layout = result.problem.layout
    assert float(layout.highs[layout.names.index("coil.R_eddy")]) == pytest.approx(30 * bench.constants["coil.R_eddy"])
    far = dataclasses.replace(bench, constants={**bench.constants, "coil.R_eddy": result.estimate("coil.R_eddy").value / 45})
    found = fit(
        recordings, far, actuator=result.actuator, start=result, spectra=result.spectra, choices=result.choices, refine=False
    )
    assert not found.estimate("coil.R_eddy").at_bound  # where it was given beyond, there it may stay
    stuck = fit(recordings, far, choices=QUICK, refine=False)
    resistance = stuck.estimate("coil.R_eddy")
    assert resistance.value == pytest.approx(30 * far.constants["coil.R_eddy"]) and resistance.at_bound
    assert "coil.R_eddy sits at its bound" in stuck.message


@pytest.mark.long
def test_a_gauge_is_told_with_what_makes_up_for_it(recordings, bench, result):
    assert result.estimate("coil.R_eddy").identified and "not identified" not in result.message
    free = fit(recordings, bench, extra=("coil.H_bias",), choices=dataclasses.replace(QUICK, max_jacobians=2), refine=False)
    bias = free.estimate("coil.H_bias")
    assert not bias.identified and "density moved" in bias.why and "not identified: coil.H_bias" in loose(free.estimates)
    learned = dataclasses.replace(bias, name="effects.learned_term.c0")
    assert loose([learned]) == "; a prior holds the coefficients of the learned term"
    assert valleys({"effects.learned_term.c0~effects.learned_term.c1": 1.0}) == "" and "coil.a" in valleys({"coil.a~coil.b": 1.0})
    assert 0.5 < result.cells["switched"] / result.cells["all"] < 1


def test_the_papers_recipe_beside_a_fit(recordings, result):
    table = recipe_beside(result, recordings)
    assert table.R_eddy == pytest.approx(62, rel=0.05) and table.damping_ratio == pytest.approx(0.81, rel=0.01)
    assert "R_eddy" in str(table)


def test_a_fit_that_misses_its_target_is_not_quoted_anew(recordings, bench, result):
    """A trial of no use costs no further Jacobians; one that comes near is quoted with a tenth of the weights, once it is asked for it."""
    same = {"choices": result.choices, "refine": False, "start": result, "spectra": result.spectra}
    missed, met = (fit(recordings, bench, actuator=result.actuator, target=t, **same) for t in (1.0, 1e9))
    assert met.converged and met.recordings and "quoted" not in vars(met)
    assert missed.refined is missed.solution and met.refined is not met.solution
    assert np.allclose(met.refined.weights, 0.1 * met.solution.weights)


def test_ctrl_c_while_a_fit_is_quoted_leaves_what_the_fit_itself_knows(monkeypatch, recordings, bench, result):
    """Stopped in its first Jacobian a further fit knows the prior alone: R_eddy was 64 +- 8323 ohm."""
    again = fit(
        recordings, bench, actuator=result.actuator, start=result, choices=result.choices, spectra=result.spectra, refine=False
    )
    monkeypatch.setattr("fitting.joint.data_jacobian", interrupt)
    assert again.quoted.interrupted and again.refined is again.solution
    assert again.estimate("coil.R_eddy").stderr < 3 * result.estimate("coil.R_eddy").stderr
    with pytest.raises(KeyboardInterrupt):
        screened(again, result.choices)


def interrupt(*arguments):
    raise KeyboardInterrupt


def test_drives_that_are_asked_for_are_predicted_by_the_programs_of_the_fit(result):
    """More of them than recordings, which have levels of M of their own; what they do to the reading is a simulation of the drive."""
    drives = [(f, 0.35, 0.1) for f in (5.0, 20.0, 60.0, 120.0, 240.0)]
    few = dataclasses.replace(result.spectra[0], drive=result.spectra[0].drive[:5], reading=result.spectra[0].reading[:5])
    r, J, known = _predicted(result, drives, (few, *result.spectra[1:]))
    layout, z, template = result.problem.layout, result.refined.z, result.problem.template
    shared, count, samples = layout.size - layout.memories, 41, result.problem.predictors[0].drives[0].shape[1]
    assert r.shape == (5, 2 * count - 1) and J.shape == (*r.shape, shared) and known.shape == (shared, shared)
    f, A, offset = drives[3]
    drive = offset + A * np.sin(2 * np.pi * np.arange(samples) / samples)
    made = simulate(layout.actuator(template, z), drive, 1 / (f * samples), periodic=True)
    first = np.fft.rfft(np.asarray(made.reading))[1] / samples
    assert first.real / r[3, 1] == pytest.approx(first.imag / r[3, count], rel=1e-6)  # both over one deviation
    k, moved = layout.index("mechanics.f0"), z.copy()
    moved[k] += 1e-4
    other = dataclasses.replace(result.quoted, refined=dataclasses.replace(result.refined, z=moved))
    ahead = _predicted(dataclasses.replace(result, quote=lambda: other), drives, result.spectra)[0]
    assert (ahead - r) / 1e-4 == pytest.approx(J[..., k], abs=1e-3 * np.abs(J[..., k]).max())


@pytest.mark.long
def test_a_given_history_is_where_every_recording_starts(recordings, bench):
    past = dataclasses.replace(bench, start=(20000.0, 5000.0, 15000.0))
    found = fit(recordings, past, choices=dataclasses.replace(QUICK, max_jacobians=2), refine=False)
    assert np.array_equal(found.actuator.hysteresis.history, past.start)


def test_noise_without_a_repeat_is_told_to_be_a_guess(recordings, bench):
    whole = recordings[0]
    n = len(whole.time) // round(whole.periods())
    one = dataclasses.replace(whole, time=whole.time[:n], channels={k: v[:n] for k, v in whole.channels.items()}, noise={})
    assert "1 of 2 recordings is a guess" in guessed([one, whole], bench) and not guessed([whole], bench)


@pytest.mark.long
def test_one_unknown_a_cell(recordings, bench):
    got = fit(recordings, bench, choices=dataclasses.replace(QUICK, knots=None, level=25), refine=False)
    assert abs(got.estimate("coil.R_eddy").value / 62 - 1) < 0.05
    assert got.actuator.hysteresis.cells == 27


def test_aperiodic_drive_is_refused_with_the_mend(bench, recordings):
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.standard_normal(2000)) * 0.01
    recording = Recording(np.arange(2000) * 1e-4, {"current": walk, "displacement": 1e-6 * walk**2}, name="walk")
    with pytest.raises(RecordingError, match="does not repeat"):
        fit([*recordings, recording], bench)


@pytest.mark.parametrize("make", [lambda: hat_basis(-100.0, 900.0, 1.0, 20, 7, 6), lambda: cell_basis(-100.0, 900.0, 1.0, 12)])
def test_linear_rows_are_the_operator(make):
    """What the start solves for is what the simulator computes."""
    basis = make()
    rng = np.random.default_rng(2)
    x = rng.random(basis.unknowns)
    field = rng.uniform(-100, 900, 40)
    operator = Preisach(basis.masses(x), basis.low, basis.high, float(basis.masses(x).sum()))
    assert operator_rows(basis, field) @ x == pytest.approx(np.asarray(operator.magnetization(field, corners=30)), abs=1e-12)
    masses = np.asarray(operator.masses)
    assert basis.hats.masses(x) == pytest.approx(masses) == np.asarray(basis.hats.masses(jnp.asarray(x)))
    assert everett_values(masses) == pytest.approx(np.asarray(operator.table().values))
    assert np.tensordot(x, basis.hats.each(0, basis.unknowns), 1) == pytest.approx(masses)
    assert np.array_equal(basis.hats.each(3, 2), basis.hats.each(0, basis.unknowns)[3:5])
    assert basis.values @ x == pytest.approx(np.asarray(operator.table().values).ravel())


def test_cells_of_many_are_the_same_density():
    """On whatever plane: uniform over a cell, uniform over each of those that it is cut into."""
    rng = np.random.default_rng(3)
    field, bases = rng.uniform(-100, 900, 60), (cell_basis(-100.0, 900.0, 2.0, 24, 6), cell_basis(-100.0, 900.0, 2.0, 6))
    x = rng.random(bases[0].unknowns)
    found, expected = (
        np.asarray(Preisach(b.masses(x), b.low, b.high, float(b.masses(x).sum())).magnetization(field, corners=60)) for b in bases
    )
    assert found == pytest.approx(expected, abs=1e-12) and np.ptp(found) > 1
    assert [a.shape for a in bases[0].penalties] == [b.shape for b in bases[1].penalties]
    with pytest.raises(ConfigurationError, match="does not divide"):
        cell_basis(-100.0, 900.0, 2.0, 24, 7)


@pytest.mark.parametrize("finer", [lambda: hat_basis(-100.0, 900.0, 1.0, 60, 26, 18), lambda: cell_basis(-100.0, 900.0, 1.0, 60, 30)], ids=["hats", "cells"])
def test_a_density_is_led_over_to_a_finer_basis(finer):
    """From the equation error each finer density had begun far above where the coarser one ended; its masses are there already."""
    basis, new = hat_basis(-100.0, 900.0, 1.0, 60, 14, 10), finer()
    x = np.random.default_rng(5).random(basis.unknowns)
    found = new.taking(x, basis)
    off = np.abs(everett_values(new.masses(found)) - everett_values(basis.masses(x)))
    assert off.max() < 0.01 * everett_values(basis.masses(x)).max() and found.min() >= 0
    assert basis.taking(x, basis) is x or np.array_equal(basis.taking(x, basis), x)
    assert new.taking(x, hat_basis(-100.0, 500.0, 1.0, 60, 14, 10)) is None  # of another plane
    assert hat_basis(-100.0, 900.0, 1.0, 30, 14, 10).taking(x, basis) is None  # of other cells


def test_a_finer_density_begins_where_the_coarser_one_ended(recordings, bench, result):
    """After one Jacobian it is nearly as near, where one from the equation error is twice as far off."""
    finer = dataclasses.replace(result.choices, knots=(26, 18), max_jacobians=1)
    led, anew = (fit(recordings, bench, actuator=result.actuator, start=s, choices=finer, refine=False) for s in (result, None))
    assert led.chi2_per_sample < 1.5 * result.chi2_per_sample < 0.75 * anew.chi2_per_sample


def test_all_densities_share_their_programs():
    """What is compiled depends on the level of the plane alone, and that is one for all."""
    assert {row.get("level", Choices().level) for step in FINER for row in step} == {Choices().level}
    assert all(Choices().level % row["cells"] == 0 for step in FINER for row in step if "cells" in row)


def test_bounded_minimum_meets_the_optimality_conditions():
    rng = np.random.default_rng(3)
    for _ in range(20):
        A = rng.standard_normal((30, 30))
        A, g, y = A @ A.T + 0.1 * np.eye(30), rng.standard_normal(30), np.maximum(rng.standard_normal(30), 0)
        y[20:24] = np.minimum(y[20:24], 0.1)
        lower, upper = np.where(np.arange(30) < 24, 0.0, -np.inf), np.where(abs(np.arange(30) - 22) < 3, 0.1, np.inf)
        d = bounded_minimum(A, g, y, (lower, upper)) - y
        slope, low, high = A @ d + g, y + d < lower + 1e-9, y + d > upper - 1e-9
        assert np.all(y + d > lower - 1e-10) and np.all(y + d < upper + 1e-10)
        assert np.abs(slope[~low & ~high]).max() < 1e-7
        assert slope[low].min(initial=0) > -1e-7 and slope[high].max(initial=0) < 1e-7


@pytest.mark.parametrize("alone", [False, True])
def test_bounded_minimum_reaches_the_optimum_where_the_normal_matrix_is_nearly_singular(monkeypatch, alone):
    """Smooth columns, a tenth of them told apart: pivoting in blocks alone ends above its start, a fall that is none. By loads on the
    diagonal that are let go, and `alone` by the active set that falls at every step."""
    rng = np.random.default_rng(0)
    if alone:
        monkeypatch.setattr(solver, "LOADS", ())
    where = np.linspace(0, 1, 120)
    for width in (0.05, 0.1, 0.2):
        columns = np.exp(-(((np.linspace(0, 1, 200)[:, None] - where) / width) ** 2))
        y = np.maximum(rng.standard_normal(120), 0)
        A = columns.T @ columns
        g = A @ y - columns.T @ (rng.standard_normal(200) + 3)
        A = A + 1e-9 * np.diag(np.diag(A))
        for upper in np.full(120, np.inf), np.full(120, 1.5):
            y = np.minimum(y, upper)
            d = bounded_minimum(A, g, y, (np.zeros(120), upper)) - y
            slope, low, high = (A @ d + g) / np.abs(g).max(), y + d < 1e-12, y + d > upper - 1e-12
            assert (y + d).min() > -1e-10 and np.all(y + d < upper + 1e-10) and g @ d + 0.5 * d @ A @ d < 0
            assert np.abs(slope[~low & ~high]).max() < 1e-7 and high.any() == np.isfinite(upper[0])
            assert slope[low].min(initial=0) > -1e-7 and slope[high].max(initial=0) < 1e-7
            again = bounded_minimum(A, g, y, (np.zeros(120), upper), y + d) - y
            assert g @ again + 0.5 * again @ A @ again == pytest.approx(g @ d + 0.5 * d @ A @ d, rel=1e-9)


def test_a_nearly_singular_normal_matrix_takes_few_solutions(monkeypatch):
    """Smooth columns under a roughness prior, from far off: blocks alone do not end, loads that are let go by decades do, and
    from near the optimum it takes next to none."""
    rng, solved = np.random.default_rng(1), []
    where = np.linspace(0, 1, 120)
    columns = 1e3 * np.exp(-(((np.linspace(0, 1, 200)[:, None] - where) / 0.2) ** 2))
    D = np.diff(np.eye(120), 2, axis=0)
    A = columns.T @ columns + 1e-6 * D.T @ D + 1e-9 * np.diag(np.sum(columns**2, axis=0))
    y = np.maximum(rng.standard_normal(120), 0)
    g, bounds = A @ y - columns.T @ (1e3 * (rng.standard_normal(200) + 3)), (np.zeros(120), np.full(120, np.inf))
    minimum = solver._minimum
    monkeypatch.setattr(solver, "_minimum", lambda *a: solved.append(1) or minimum(*a))
    found = bounded_minimum(A, g, y, bounds)
    first = len(solved)
    bounded_minimum(A, g, y, bounds, found)
    loaded, solved[:] = (first, len(solved) - first), []
    monkeypatch.setattr(solver, "LOADS", ())
    bounded_minimum(A, g, y, bounds)
    assert loaded[1] < 5 and loaded[0] < 0.7 * len(solved)


def test_solver_runs_behind_optimistix():
    target = jnp.asarray([1.0, -2.0, 3.0])

    def residual(y, args):
        return jnp.concatenate([jnp.exp(0.3 * y) - jnp.exp(0.3 * target), 0.01 * y])

    bounds = jnp.asarray([0.0, 0.0, -jnp.inf]), jnp.asarray([jnp.inf, jnp.inf, 2.5])
    solution = optx.least_squares(residual, ProjectedLevenbergMarquardt(bounds, atol=1e-9), jnp.ones(3), max_steps=50)
    assert float(solution.value[1]) == 0.0 and float(solution.value[2]) == 2.5
    assert float(solution.value[0]) == pytest.approx(1.0, abs=0.01)


def test_steps_asked_for_one_by_one_end_where_optimistix_ends():
    """The fit's own solver through the same interface: init, step, terminate, its prior beside the residual."""
    target, weight = np.asarray([1.0, -2.0, 3.0]), 1e-4 * np.eye(3)

    def residual(y, args):
        return np.exp(0.3 * y) - np.exp(0.3 * target), None

    def traced(y, args):
        return jnp.concatenate([jnp.exp(0.3 * y) - jnp.exp(0.3 * target), 1e-2 * y])

    bounds = np.asarray([0.0, 0.0, -np.inf]), np.asarray([np.inf, np.inf, 2.5])
    solver = SteppedLevenbergMarquardt(bounds, rtol=0.0, atol=1e-14)
    options = {"jacobian": lambda y: np.diag(0.3 * np.exp(0.3 * y)), "prior": weight}
    y, steps, tags = np.ones(3), 0, frozenset()
    state = solver.init(residual, y, None, options, None, None, tags)
    while not solver.terminate(residual, y, None, options, state, tags)[0] and steps < 50:
        before = state.cost
        y, state, _ = solver.step(residual, y, None, options, state, tags)
        steps += 1
        assert state.gained == pytest.approx(before - state.cost)
    other = optx.least_squares(traced, ProjectedLevenbergMarquardt(bounds, rtol=0.0, atol=1e-14), jnp.ones(3), max_steps=50)
    assert steps < 20 and y == pytest.approx(np.asarray(other.value), abs=1e-6) and list(y[1:]) == [0.0, 2.5]


@pytest.mark.parametrize("slope", [1e200, np.inf, np.nan])
def test_from_a_start_beyond_all_reason_no_step_is_taken_and_nothing_warns(slope):
    """A trial whose effect began there: the square of its Jacobian overflows."""
    solver, tags = SteppedLevenbergMarquardt((np.full(2, -np.inf), np.full(2, np.inf))), frozenset()
    residual = lambda y, args: (np.asarray([1e100, 1.0, 1.0]), None)
    options = {"jacobian": lambda y: np.asarray([[slope, 1.0], [0.0, 1.0], [1.0, 2.0]]), "prior": np.eye(2)}
    state = solver.init(residual, np.ones(2), None, options, None, None, tags)
    y, state, _ = solver.step(residual, np.ones(2), None, options, state, tags)
    assert list(y) == [1.0, 1.0] and not state.good and state.decrement == np.inf
    assert np.isfinite(state.information + options["prior"]).all()


def test_solver_behind_optimistix_bears_hundreds_of_unknowns():
    """As `scipy.optimize.nnls` ends; with a call back to NumPy in the step this waited forever."""
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((600, 300)), rng.standard_normal(600)
    bounds = jnp.zeros(300), jnp.full(300, jnp.inf)
    solver = ProjectedLevenbergMarquardt(bounds, rtol=1e-12, atol=1e-12)
    found = optx.least_squares(lambda y, args: jnp.asarray(A) @ y - jnp.asarray(b), solver, jnp.ones(300), max_steps=50).value
    expected, _ = scipy.optimize.nnls(A, b)
    assert np.abs(np.asarray(found) - expected).max() < 1e-6 * expected.max() and 50 < (expected == 0).sum() == (found == 0).sum()


def test_lines_need_no_whole_periods():
    f, dt, n = 7.3, 1e-3, 1234
    t = dt * np.arange(n)
    signal = 0.5 + 2 * np.cos(2 * np.pi * f * t - 0.4) + 0.3 * np.sin(6 * np.pi * f * t)
    lines, rest = fit_lines(signal, f * t, 6)
    assert lines[0].real == pytest.approx(0.5) and lines[1] == pytest.approx(np.exp(-0.4j)) and abs(lines[3]) == pytest.approx(0.15)
    assert np.abs(rest).max() < 1e-10


def test_noise_is_found_between_the_harmonics():
    rng = np.random.default_rng(4)
    spectra = []
    for f in (10, 40):
        n = 4000
        t = np.arange(n) / (1000 * f)
        drive = np.sin(2 * np.pi * f * t)
        y = 1e-5 * drive**3 + 30e-9 * rng.standard_normal(n)
        spectra.append(
            reduce_recording(Recording(t, {"current": drive, "displacement": y}, name=str(f)), "current", "displacement")
        )
    assert estimate_noise(spectra).rms == pytest.approx(30e-9, rel=0.05)


@pytest.mark.parametrize("by_rate", [True, False], ids=["by the sampling rate", "by frequency"])
def test_the_colour_of_the_noise_goes_by_frequency_or_by_the_sampling_rate(by_rate):
    """Flicker of records made one by one moves with their rate; by frequency it would be missed tenfold at the low orders."""
    rng = np.random.default_rng(6)
    spectra, true = [], []
    for f in (5, 20, 80, 320):
        n, dt = 2000, 1 / (500 * f)
        frequencies = np.fft.rfftfreq(n, dt)
        flicker = 1e-18 * (0.02 / (frequencies[1:] * dt) if by_rate else 200.0 / frequencies[1:])
        white = np.fft.rfft(rng.standard_normal(n))
        white[1:] *= np.sqrt(4e-16 + 1e2 * flicker)
        t = dt * np.arange(n)
        drive = np.sin(2 * np.pi * f * t)
        channels = {"current": drive, "displacement": 1e-5 * drive**3 + np.fft.irfft(white, n)}
        spectra.append(reduce_recording(Recording(t, channels, name=str(f)), "current", "displacement"))
        true.append(4e-16 + 1e2 * flicker[3])  # at the fundamental: the fourth bin of the record
    found = [s.noise.density(s.frequency) for s in with_noise(spectra)]
    assert np.log(np.asarray(found) / true) == pytest.approx(np.zeros(4), abs=0.35)
    assert np.log(estimate_noise(spectra).density(5.0) / true[0]) == pytest.approx(0.0, abs=0.35) or by_rate


@pytest.mark.parametrize("levels", [(30e-9, 60e-9), (30e-9, 33e-9)])
def test_noise_is_each_recordings_own_where_it_differs_and_pooled_where_not(levels):
    rng = np.random.default_rng(4)
    spectra = []
    for k in range(6):
        t = np.arange(500) / (500 * (k + 1))
        drive = np.sin(2 * np.pi * (k + 1) * t)
        y = 1e-5 * drive**3 + levels[k % 2] * rng.standard_normal(500)
        spectra.append(
            reduce_recording(Recording(t, {"current": drive, "displacement": y}, name=str(k)), "current", "displacement")
        )
    found = [s.noise.rms for s in with_noise(spectra)]
    if levels[1] > 1.5 * levels[0]:
        assert np.allclose(found, np.tile(levels, 3), rtol=0.2)
    else:
        assert len(set(found)) == 1


def test_unfold_finds_the_sign_of_M():
    drive = np.cos(2 * np.pi * np.arange(200) / 200)
    M = drive - 0.3
    # the one sample beside the crossing may fall on either side
    assert unfold(np.abs(M), drive) == pytest.approx(M, abs=0.035)
    assert unfold(np.abs(drive + 3), drive) == pytest.approx(drive + 3)


@pytest.mark.parametrize("offset", [2.0, 1.1, 1.0, 0.9, 0.5, 0.2, 0.0])
def test_unfold_sees_through_noise(offset):
    """Magnetizations that stay positive, just touch zero and cross it, behind a reading with noise: the sign of every loop."""
    rng, phase = np.random.default_rng(4), 2 * np.pi * np.arange(200) / 200
    for lag, bend in rng.uniform((0.0, -0.3), (0.8, 0.3), (10, 2)):
        M = np.sin(phase - lag) + offset + bend * np.cos(2 * phase)
        drive = np.sin(phase)
        reading = M**2 + 1e-3 * rng.standard_normal(200)
        found = unfold(np.sqrt(np.maximum(reading, 0.0)), drive)
        assert np.sqrt(np.mean((found - M * np.sign(M[np.argmax(drive)])) ** 2)) < 0.1


@pytest.mark.parametrize(("lowest", "smoothing", "turns"), [(-0.4, 4, True), (-0.4, 5, True), (0.1, 4, False), (-0.1, 8, False)],
                         ids=["lobe", "blurred lobe", "one sign", "hardly a lobe"])  # fmt: skip
def test_dips_tell_the_sign_that_damping_blurs(lowest, smoothing, turns):
    """A structural_damping of 3.8 %: |M| fell to 0.22 and 0.16 of its largest where it passed through zero, with a lobe of 0.43 between."""
    turn = np.arange(200) / 200
    drive = np.cos(2 * np.pi * turn)
    M = lowest + (1 - lowest) / 2 * (1 + np.tanh(6 * np.cos(2 * np.pi * (turn - 0.04))))  # from `lowest` to 1, steep
    lines = np.fft.rfft(M**2) * np.exp(-0.5 * (np.arange(101) / (60 / smoothing)) ** 2)
    root = np.sqrt(np.maximum(np.fft.irfft(lines, 200), 0.0))
    found = unfold(root, drive, dips=True)
    assert bool((found < 0).any()) is turns and np.abs(found) == pytest.approx(root)
    if turns:
        assert not (unfold(root, drive) < 0).any()
        assert np.mean((found < 0) == (M < 0)) > 0.95


def test_a_drive_that_turns_twice_above_zero_has_no_lobe_between_its_dips():
    turn = np.arange(200) / 200
    M = 0.6 + 0.5 * np.cos(4 * np.pi * turn) + 0.05 * np.cos(2 * np.pi * turn)
    assert (unfold(M, np.cos(4 * np.pi * turn) + 0.1 * np.cos(2 * np.pi * turn), dips=True) > 0).all()


def test_a_reading_that_is_negative_throughout_starts_without_a_warning(recordings, bench):
    """No strain of the rod is negative: there is no M behind it, and nothing to scale by."""
    turned = [dataclasses.replace(r, channels={**r.channels, "displacement": -r.channels["displacement"]}) for r in recordings]
    spectra, actuator = spectra_of(turned, bench, 8), bench.actuator()
    deviations = [np.full(9, 1e-9)] * len(spectra)
    basis = hat_basis(-2e4, 4e4, 1e5, 20, 6, 5)
    with np.errstate(all="raise"):
        x, bottom, misfit = equation_error_start(basis, spectra, deviations, actuator)
    assert np.isfinite(x).all() and np.isfinite([bottom, misfit]).all()


@pytest.mark.long
def test_loops_whose_strain_does_not_come_back_to_zero_are_begun_with_its_sign_turned(tmp_path):
    """A reading 0.3 um off, as friction or a strain that lags leaves it: M seemed to stay positive, and no density meets that."""
    text = Path(magjax.bench.__file__).with_name("benches").joinpath("aa-050h.toml").read_text()
    (tmp_path / "bench.toml").write_text(re.sub(r"H_bias *= *[0-9.e+]+", "H_bias = 9000", text))
    bench = load_bench(tmp_path / "bench.toml")

    def density(s, r):
        steep = np.exp(-0.5 * (np.log(np.maximum(r, 1e-9) / 3500) / 0.3) ** 2) / np.maximum(r, 1.0)
        return steep * np.exp(-0.5 * (s / 4000) ** 2)

    truth = bench.actuator().replace(TRUE)
    masses = density_masses(density, 80, -14e3, 24e3, 0.8 * float(truth.magnetostriction.M_s), refine=4)
    truth = dataclasses.replace(truth, hysteresis=Preisach(masses, -14e3, 24e3))
    rng, runs = np.random.default_rng(3), []
    for drive in ((10, 0.9, 0.0), (40, 0.7, -0.1), (80, 0.9, 0.0), (200, 0.6, 0.1)):
        run = record(truth, *drive, rng, str(drive))
        runs.append(dataclasses.replace(run, channels={**run.channels, "displacement": run.channels["displacement"] + 3e-7}))
    got = fit(runs, bench, choices=QUICK, refine=False)
    assert got.choices.touching and got.chi2_per_sample < 200  # 4177 with M of one sign


@pytest.mark.parametrize("bias", [4000.0, 0.0])
def test_loops_of_an_actuator_with_little_bias_are_met(tmp_path, bias):
    """The magnetization passes zero and the displacement folds there: butterflies, which hide the sign of M."""
    text = Path(magjax.bench.__file__).with_name("benches").joinpath("aa-050h.toml").read_text()
    (tmp_path / "bench.toml").write_text(re.sub(r"H_bias *= *[0-9.e+]+", f"H_bias = {bias}", text))
    bench = load_bench(tmp_path / "bench.toml")

    def density(s, r):
        return np.exp(-0.5 * (np.log(np.maximum(r, 1e-9) / 1500) / 0.6) ** 2) / np.maximum(r, 1.0) * (1 + (s / 9000) ** 2) ** -2

    truth = bench.actuator().replace(TRUE)
    masses = density_masses(density, 80, -22e3, 22e3, 0.9 * float(truth.magnetostriction.M_s), refine=4)
    truth = dataclasses.replace(truth, hysteresis=Preisach(masses, -22e3, 22e3))
    rng = np.random.default_rng(3)
    drives = ((10, 0.8, 0.1), (40, 0.5, -0.1), (80, 0.8, 0.1), (200, 0.5, 0.2))
    runs = [record(truth, *drive, rng, str(drive)) for drive in drives]
    assert runs[0].channels["displacement"].min() < 1e-7  # it does touch
    got = fit(runs, bench, choices=QUICK, refine=False)
    assert got.chi2_per_sample < 1.2
    assert all(abs(got.estimate(n).value - true) < 4 * got.estimate(n).stderr for n, true in TRUE.items())


def test_what_an_independent_bench_does_elsewhere_is_foretold(bench):
    """A draw of `tests.studies.joint_fit`, four of its sines: another frequency, a multisine, a modulated sine to 1.5 of their noise."""
    recordings, start = one_draw(settled("gauss"), 0)
    some = [recordings[k] for k in (0, 2, 5, 8)]  # as many as above: the same programs serve
    got = fit(some, bench, actuator=bench.actuator().replace(start), choices=QUICK, refine=False)
    assert got.converged and got.chi2_per_sample < 1.1
    assert all(abs(got.estimate(n).value - TRUTH[short]) < 3 * got.estimate(n).stderr for n, short in NAMES.items())
    rows = check_errors(got.actuator, got.actuator, recordings[len(SINES) :], bench)
    assert len(rows) == 3 and all(row["rms_after"] < 1.5 * row["noise_rms"] for row in rows)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(40))
def test_constants_within_their_errors_at_forty_seeds(bench, seed):
    rng = np.random.default_rng(seed)
    truth = concealed_actuator(bench)
    drives = ((10, 0.8, 0.1), (20, 0.5, -0.2), (50, 0.8, 0.1), (100, 0.5, -0.2), (150, 0.8, 0.1), (200, 0.5, -0.2), (300, 0.8, 0.1))
    got = fit([record(truth, *d, rng, str(d[0])) for d in drives], bench)
    assert all(abs(got.estimate(n).value - v) < 4 * got.estimate(n).stderr for n, v in TRUE.items())
    jax.clear_caches()


@pytest.mark.long
def test_constants_are_not_drawn_off_by_masses_that_cannot_be_negative(bench):
    """Where the density is next to nothing noise can only add to it: on a rough one f0 lay 1.5 of its errors low in the mean."""
    signals, bound, quoted = settled("rough"), [], []
    for draw in range(4):
        made, start = one_draw(signals, draw)
        found = fit(made[: len(SINES)], bench, actuator=bench.actuator().replace(start))
        f0, layout = found.estimate("mechanics.f0"), found.problem.layout
        assert not layout.inside(found.refined.z)[: layout.density_unknowns].all()
        for rows, value in ((bound, float(layout.value("mechanics.f0", found.refined.z))), (quoted, f0.value)):
            rows.append((value - TRUTH["f0"]) / f0.stderr)
    assert abs(np.mean(quoted)) < 0.75 * abs(np.mean(bound)) and -np.mean(bound) > 0.8
    assert np.abs(quoted).max() < 2.0


def test_a_bias_freed_with_a_prior_comes_back(recordings, bench):
    """H_bias shifts with the density, so it is free only with a prior; R_eddy does not care."""
    stated = dataclasses.replace(bench, priors={"coil.H_bias": 60.0})
    got = fit(recordings, stated, extra=("coil.H_bias",), choices=QUICK, refine=False)
    bias, resistance = got.estimate("coil.H_bias"), got.estimate("coil.R_eddy")
    assert got.chi2_per_sample < 1.3 and abs(bias.value - 1.23e4) < 4 * bias.stderr < 400
    assert bias.stderr >= 60  # the data do not know it better
    assert abs(resistance.value / 62 - 1) < 0.02


@pytest.mark.long
def test_lambda_s_freed_with_a_prior_comes_back_and_the_valley_is_told(recordings, bench):
    """Stroke and mass scale make up for each other, and R_eddy with them: the errors are as wide as the prior lets them."""
    name, true = "magnetostriction.lambda_s", 1.313e-3
    stated = dataclasses.replace(bench, priors={name: 0.02 * true})
    got = fit(
        recordings, stated, actuator=bench.actuator().replace({name: 0.98 * true}), extra=(name,), choices=QUICK, refine=False
    )
    stroke, resistance = got.estimate(name), got.estimate("coil.R_eddy")
    assert got.converged and got.chi2_per_sample < 1.1
    # no less than the prior's; widened as all errors are, and by what the floor of the density does
    assert abs(stroke.value - true) < 3 * stroke.stderr and 0.02 < stroke.stderr / true < 0.04
    assert abs(resistance.value - 62) < 3 * resistance.stderr and resistance.stderr > 0.4
    assert "a valley" in got.message and "lambda_s" in got.message


@pytest.mark.parametrize(
    ("samples", "per_period", "whole"),
    [(983, 8192 / 25, 3), (1000, 250.003, 4), (1000, 249.997, 4), (999, 250.0, 3), (300, 100.0, 3), (301, 100.0, 3), (80, 100.0, 0)],
)
def test_periods_that_do_not_divide_the_sampling_lose_none(samples, per_period, whole):
    """Three periods of 25 Hz at 8192 a second end between two samples: int(3 / 25 * 8192) of them hold all three."""
    assert whole_periods(samples, per_period) == whole


def test_a_record_that_ends_between_two_samples_is_used_to_its_end():
    rate, f, noise = 8192.0, 25.0, 5e-8
    t = np.arange(int(3 / f * rate)) / rate
    rng = np.random.default_rng(3)
    y = 1e-5 * np.sin(2 * np.pi * f * t - 0.4) + 2e-6 * np.cos(4 * np.pi * f * t) + noise * rng.normal(size=len(t))
    run = Recording(t, {"current": 0.5 * np.sin(2 * np.pi * f * t), "displacement": y}, name="rate")
    s = reduce_recording(run, "current", "displacement")
    assert (s.periods, s.samples) == (3, len(t))
    assert abs(s.reading[1] - 0.5e-5 * np.exp(-1j * (0.4 + np.pi / 2))) < 4 * noise / np.sqrt(len(t))
    assert abs(s.reading[2] - 1e-6) < 4 * noise / np.sqrt(len(t))
    assert run.repeats("displacement").shape == (2, 328)  # at the last phase of the third nothing was sampled
    assert run.repeat_noise("displacement") == pytest.approx(noise, rel=0.15)


def test_a_step_is_led_back_into_the_valley_that_it_left():
    """r = (50 (a b - 1), a - 3): along a b = 1 a straight step leaves the valley; led back it falls, by the Jacobian at hand."""

    def residual(z):
        return np.array([50 * (z[0] * z[1] - 1), z[0] - 3, 0.0])

    bounds = np.full(2, -np.inf), np.full(2, np.inf)
    z, damping = np.array([1.0, 1.0]), 1e-3
    J = np.array([[50 * z[1], 50 * z[0]], [1.0, 0.0], [0.0, 0.0]])
    r, normal = residual(z), J.T @ J
    new = z - np.linalg.solve(normal + damping * np.diag(np.diag(normal)), J.T @ r)
    back = led_back(normal, J.T @ (residual(new) - r) - normal @ (new - z), new, damping, bounds)
    straight_cost, back_cost, cost = (float(np.sum(residual(x) ** 2)) for x in (new, back, z))
    assert straight_cost > 5 * cost and back_cost < 0.75 * cost and back[0] > 1.2
    held = led_back(normal, np.array([1.0, -9.0]), np.array([1.2, 0.0]), damping, (np.zeros(2), np.full(2, np.inf)))
    assert held[1] == 0.0 and held[0] < 1.2  # what the step has put at its bound stays there


@pytest.mark.parametrize(("rises", "asked"), [(1.0, True), (3.0, False)], ids=["a little", "far"])
def test_a_step_that_rises_far_is_not_led_back(monkeypatch, rises, asked):
    """What rises by more than twice what it promised to fall is seldom saved: more damping is asked for at once."""
    from fitting import solver

    led = []
    monkeypatch.setattr(solver, "led_back", lambda normal, gradient, new, *rest: led.append(new) or new)
    start, count = np.array([100.0]), [0]

    def fn(z, args):
        count[0] += 1
        size = 100.0 if count[0] == 1 else 100.0 * np.sqrt(1 + rises) if count[0] == 2 else 50.0
        return np.array([size]), None

    method = SteppedLevenbergMarquardt((np.full(1, -np.inf), np.full(1, np.inf)))
    options = {"prior": np.zeros((1, 1)), "jacobian": lambda z: np.ones((1, 1))}
    state = method.init(fn, start, None, options, None, None, frozenset())
    method.step(fn, start, None, options, state, frozenset())
    assert bool(led) == asked


def test_parameters_stay_between_their_bounds(monkeypatch):
    """A share in 0 .. 1 that the data pull to 3, a power in -0.5 .. 0.5, a time constant without an upper end."""
    from fitting import joint
    from fitting.model import Layout

    basis = DensityBasis(0.0, 1.0, 2, csc_array(np.ones((4, 1))), (), 1.0, np.ones(1), 1, 1)
    ends = np.array([0.0, -0.5, 0.0, -np.inf]), np.array([1.0, 0.5, np.inf, np.inf])
    layout = Layout.build(basis, "abcd", [0.0, 0.2, 2.0, 5.0], [0.5, 0.1, 1.0, 1.0], *ends, [False, False, True, False])
    assert layout.bounds[0] == pytest.approx([0, -np.inf, 0, -7, -np.inf, -np.inf])
    assert layout.bounds[1] == pytest.approx([np.inf, np.inf, 2, 3, np.inf, np.inf])
    wanted = np.array([9.0, 0.0, 6.0, -20.0, 0.7, -3.0])
    mixed = np.eye(6) + 0.1
    monkeypatch.setattr(joint, "data_residual", lambda problem, z, stride=1: 10 * mixed @ (np.asarray(z) - wanted))
    monkeypatch.setattr(joint, "data_jacobian", lambda problem, z: 10 * mixed)
    monkeypatch.setattr(joint, "prior_matrix", lambda problem, weights: 1e-9 * np.eye(6))
    found = joint.solve(SimpleNamespace(layout=layout, data_count=6, passes=ONE_GRID), np.zeros(6), np.ones(0), evidence=False)
    assert [float(layout.value(name, found.z)) for name in "ab"] == pytest.approx([1.0, -0.5])
    assert list(layout.inside(found.z)) == [True, True, False, False, True, True] and found.converged


@pytest.mark.parametrize("most", [(4, 1.0, 5e-4), (99, 1.0, 5e-4)], ids=["as it is", "without the rule"])
def test_an_iteration_that_brings_nothing_more_ends(monkeypatch, most):
    """A kink whose derivative promises a fall that no step brings: nothing is gained by the rest of the Jacobians."""
    from fitting import joint, solver

    kinked = lambda z: np.concatenate([10.0 * (z - 1.0), 40.0 + 6.0 * np.abs(z)])  # noqa: E731
    sloped = lambda z: np.concatenate([10.0 * np.eye(2), 6.0 * np.eye(2)])  # noqa: E731  one side's, on both
    monkeypatch.setattr(joint, "data_residual", lambda problem, z, stride=1: kinked(np.asarray(z)))
    monkeypatch.setattr(joint, "data_jacobian", lambda problem, z: sloped(z))
    monkeypatch.setattr(joint, "prior_matrix", lambda problem, weights: 1e-9 * np.eye(2))
    monkeypatch.setattr(solver, "led_back", lambda normal, gradient, new, *rest: new)
    monkeypatch.setattr(joint, "evidence_weights", lambda layout, penalties, z, normal, weights: weights)
    monkeypatch.setattr(joint, "AT_END", most)
    layout = SimpleNamespace(bounds=(np.full(2, -np.inf), np.full(2, np.inf)))
    problem = SimpleNamespace(layout=layout, penalties=(), stiffness=None, data_count=1000, passes=ONE_GRID)
    found = joint.solve(problem, np.asarray([2.0, 0.5]), np.ones(1))
    assert found.jacobians < 12 if most[0] == 4 else found.jacobians == 30


def two_grids(monkeypatch, off):
    """A curved problem whose coarse grid has its misfit otherwise by `off(z)`: how often each grid was asked, and the solution."""
    from fitting import joint

    rng = np.random.default_rng(4)
    mixed, measured = rng.normal(size=(12, 3)), 30.0 * rng.normal(size=12)
    asked = {1: 0, 4: 0}

    def misfit(problem, z, stride=1):
        asked[stride] += 1
        z = np.asarray(z)
        return 40.0 * mixed @ np.sinh(z) - measured + (0.0 if stride == 1 else off(z))

    monkeypatch.setattr(joint, "data_residual", misfit)
    monkeypatch.setattr(joint, "data_jacobian", lambda problem, z: 40.0 * mixed * np.cosh(z))
    monkeypatch.setattr(joint, "prior_matrix", lambda problem, weights: 1e-9 * np.eye(3))
    layout = SimpleNamespace(bounds=(np.full(3, -np.inf), np.full(3, np.inf)))

    def solved(stride):
        asked.update({1: 0, 4: 0})
        problem = SimpleNamespace(layout=layout, data_count=12, passes=SimpleNamespace(stride=stride))
        return joint.solve(problem, np.full(3, 2.0), np.ones(0), evidence=False), dict(asked)

    return solved


def test_trial_steps_go_by_a_coarser_grid_and_end_where_the_fine_one_does(monkeypatch):
    shape = 5.0 * np.random.default_rng(5).normal(size=12)
    solved = two_grids(monkeypatch, lambda z: shape * (1 + 0.1 * np.tanh(z[0])))
    (fine, alone), (both, few) = solved(1), solved(4)
    assert fine.converged and both.converged and both.z == pytest.approx(fine.z, abs=2e-3)
    assert both.chi2 == pytest.approx(fine.chi2, rel=1e-3) and both.chi2 > 100  # a misfit is left
    assert both.chi2 == pytest.approx(float(np.sum(joint_misfit(both.z) ** 2)), rel=1e-12)  # as the fine grid has it
    assert few[1] < alone[1] / 2 and few[4] > few[1]


def joint_misfit(z):
    from fitting import joint

    return joint.data_residual(None, z)


def test_a_step_that_falls_on_the_coarse_grid_alone_is_taken_on_the_fine_one(monkeypatch):
    """The coarse grid has a valley of its own beside the way."""
    solved = two_grids(monkeypatch, lambda z: 4000.0 * (z[0] - 1.9))
    (fine, _), (both, _) = solved(1), solved(4)
    assert both.converged and both.chi2 == pytest.approx(fine.chi2, rel=2e-3) and both.z == pytest.approx(fine.z, abs=2e-2)


def test_no_step_is_kept_that_rises_on_the_fine_grid(monkeypatch):
    """The coarse grid, and its Jacobian, have the whole slope the wrong way round."""
    from fitting import joint

    monkeypatch.setattr(joint, "data_residual", lambda problem, z, stride=1: (20.0 if stride == 1 else -10.0) * np.asarray(z))
    monkeypatch.setattr(joint, "data_jacobian", lambda problem, z: -10.0 * np.eye(1))
    monkeypatch.setattr(joint, "prior_matrix", lambda problem, weights: 1e-9 * np.eye(1))
    layout = SimpleNamespace(bounds=(np.full(1, -np.inf), np.full(1, np.inf)))
    problem = SimpleNamespace(layout=layout, data_count=1, passes=SimpleNamespace(stride=4))
    found = joint.solve(problem, np.ones(1), np.ones(0), evidence=False)
    assert found.chi2 == 400.0 and found.z == [1.0] and not found.converged


def test_an_iteration_that_is_too_slow_for_its_target_ends():
    from fitting.joint import _too_slow

    falling = [100.0 - k for k in range(8)]  # by one a Jacobian
    assert _too_slow(falling, left=10, target=82.0) and not _too_slow(falling, left=10, target=84.0)
    assert not _too_slow(falling[:5], left=10, target=50.0)  # too early to tell
    assert not _too_slow(falling, left=10, target=np.inf)


def test_a_fast_loop_passes_zero_where_slower_ones_do():
    wide, narrow = (-1.0, 1.0), (-0.6, 0.6)
    assert agreeing([wide, narrow, wide, wide], [True, False, False, True]) == [0, 1, 3]  # the third must turn as the first does
    assert agreeing([wide, narrow], [False, True]) == [0]  # inside a loop that does not turn none does
    assert agreeing([narrow, wide], [False, True]) == [0, 1] and agreeing([narrow, wide], [True, False]) == [0]


def test_one_period_is_no_steady_state():
    with pytest.raises(ConfigurationError, match="periods = 1: a steady state takes two"):
        build_problem((), None, None, (), Choices(periods=1))


@pytest.mark.parametrize(("flat", "factor"), [(0.0, 1.0), (1.5, 2.0), (100.0, 8 / np.sqrt(0.7))])
def test_an_error_goes_as_far_as_the_fine_grid_lets_it(monkeypatch, flat, factor):
    """A misfit that does not move within `flat` standard errors of the Jacobian's; of what nothing holds, eight times the error is said, and more."""
    layout = SimpleNamespace(bounds=(np.full(2, -np.inf), np.full(2, np.inf)))
    solution = SimpleNamespace(z=np.zeros(2), weights=())
    monkeypatch.setattr("fitting.joint.prior_matrix", lambda *_: np.zeros((2, 2)))
    cov = np.diag([4.0, 9.0])
    monkeypatch.setattr(
        "fitting.joint.data_residual", lambda _, z: np.append(np.sign(z[0]) * max(abs(z[0]) / 2 - flat, 0.0), z[1] / 3)
    )
    problem = SimpleNamespace(layout=layout)
    assert widened(problem, solution, cov, 0) == pytest.approx(factor)
    assert widened(problem, solution, cov, 1) == 1.0
