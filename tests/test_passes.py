"""The fit's residual and Jacobian by programs that all fits share, against the whole chain."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import magjax.effects as effects
from fitting.demo import concealed_actuator, record
from fitting.joint import data_jacobian, data_residual, fields
from fitting.model import predicted_lines, whitened
from fitting.screen import columns
from fitting.setup import Choices, build_problem, effect_parameters, free_parameters, spectra_of
from magjax import programs
from magjax.bench import load_bench
from magjax.chain.march import magnetize
from magjax.recording import Recording

SMALL = Choices(fine=128, coarse=90, knots=(16, 12), level=24, rest="negative")


def modulated(truth, name="modulated"):
    """Two lines far apart: a grid of its own."""
    from magjax.simulate import simulate

    t = np.arange(2000) / 2000 / 20.0
    current = 0.1 + 0.4 * np.sin(2 * np.pi * 20 * t) + 0.2 * np.sin(2 * np.pi * 160 * t)
    y = np.asarray(simulate(truth, current, t[1], periodic=True).displacement)
    return Recording(t[1] * np.arange(2 * len(t)), {"current": np.tile(current, 2), "displacement": np.tile(y, 2)}, name=name)


def problem_of(recordings, actuator=None, **choices):
    bench = load_bench("aa-050h")
    actuator = actuator or bench.actuator()
    names = free_parameters(bench, actuator, effect_parameters(actuator))
    spectra = spectra_of(recordings, bench, SMALL.harmonics)
    return build_problem(spectra, actuator, bench, names, dataclasses.replace(SMALL, **choices))


def some(*frequencies, noise=2):
    rng = np.random.default_rng(noise)
    return [record(concealed_actuator(load_bench("aa-050h")), f, 0.6, 0.0, rng, f"{f}") for f in frequencies]


@pytest.mark.long
@pytest.mark.parametrize("rest", ["negative", "demagnetized"])
def test_they_are_those_of_the_whole_chain(rest):
    """Seven recordings on two grids, more unknowns than go through at once, effects on either side of the hysteresis."""
    recordings = [modulated(concealed_actuator(load_bench("aa-050h"))), *some(20, 50, 90, 120, 150, 200)]
    actuator = load_bench("aa-050h").actuator()
    for effect in (effects.ExcessLoss(k=10.0), effects.SensorLag(tau=5e-5), effects.DeltaE(e=0.02)):
        actuator = actuator.with_effect(effect)
    problem, z = problem_of(recordings, actuator, rest=rest)
    z = z + np.random.default_rng(1).uniform(0, 0.01, len(z))
    layout, template, (coarse, fine) = problem.layout, problem.template, problem.predictors
    assert len(z) > 114 and len(coarse.drives) == 2 and fine.drives[0].shape > coarse.drives[0].shape

    def residual(y):
        return whitened(coarse(layout.actuator(template, y), layout.levels(y)), problem.target)

    push = jax.jit(jax.vmap(lambda d: jax.jvp(residual, (jnp.asarray(z),), (d,)), out_axes=(None, 0)))
    whole, changes = (np.asarray(x) for x in push(jnp.eye(len(z))))
    problem = dataclasses.replace(problem, predictors=(coarse, coarse))  # one grid to compile for
    assert data_residual(problem, z) == pytest.approx(whole, rel=1e-9, abs=1e-9)
    found, expected = data_jacobian(problem, z), changes.T
    assert found.shape == expected.shape
    assert np.all(np.abs(found - expected) <= 1e-10 * np.abs(expected).max(axis=0) + 1e-13 * np.abs(expected).max())
    moves = np.linalg.norm(found, axis=0) > 0  # each of them does something, but relays at the edge of the plane
    assert moves[layout.density_unknowns :].all() and moves.mean() > 0.9
    for (drive, H, M), s in zip(fields(problem, z), problem.spectra, strict=True):
        assert len(drive) == len(H) == len(M) and drive == pytest.approx(s.drive_at(np.arange(len(drive)) / len(drive)))


def along_some_directions(*held, R_eddy=None, **choices):
    """The change of the misfit along some directions of all unknowns, (directions, data): by the Jacobian, and by the whole chain."""
    actuator = load_bench("aa-050h").actuator()
    for effect in held:
        actuator = actuator.with_effect(effect)
    problem, z = problem_of(some(20, 200), actuator, rest="demagnetized", **choices)
    rng = np.random.default_rng(3)
    z = z + rng.uniform(0, 0.01, len(z))
    if R_eddy:
        z[problem.layout.index("coil.R_eddy")] = problem.layout.coordinate("coil.R_eddy", R_eddy)
    layout, coarse = problem.layout, problem.predictors[0]

    @jax.jit
    def pushed(directions):
        def residual(y):
            return whitened(coarse(layout.actuator(problem.template, y), layout.levels(y)), problem.target)

        return jax.vmap(lambda d: jax.jvp(residual, (jnp.asarray(z),), (d,))[1])(directions)

    n = layout.density_unknowns
    directions = np.zeros((len(z) - n + 2, len(z)))
    directions[:2, :n] = rng.normal(size=(2, n))
    directions[2:, n:] = np.eye(len(z) - n)
    return directions @ data_jacobian(problem, z).T, np.asarray(pushed(directions))


@pytest.mark.long
@pytest.mark.parametrize("beside", [(), (effects.MagneticAftereffect(share=0.02),)], ids=len)
def test_so_they_are_of_a_rod_in_shells(beside):
    found, expected = along_some_directions(effects.FieldDiffusion(kappa=0.7), *beside)
    largest = np.abs(expected).max(axis=1)
    assert largest.min() > 0
    assert np.all(np.abs(found - expected).max(axis=1) < 1e-8 * largest)


@pytest.mark.long
@pytest.mark.parametrize("effect", [effects.MagneticAftereffect(share=0.02), effects.SecondEddyPath(kappa=0.3)], ids=lambda e: e.name)
def test_so_they_are_of_states_that_are_led_to_where_they_repeat(effect):
    """The end of a period reads what stood at the one before."""
    found, expected = along_some_directions(effect)
    largest = np.abs(expected).max(axis=1)
    assert largest.min() > 0
    assert np.all(np.abs(found - expected).max(axis=1) < 1e-8 * largest)


@pytest.mark.parametrize(
    ("held", "periods", "R_eddy", "near"),
    [
        ((), 8, 70.0, 1e-6),
        pytest.param((), 24, 25.0, 1e-4, marks=pytest.mark.long),
        pytest.param((effects.FieldDiffusion(kappa=0.7),), 24, 70.0, 1e-4, marks=pytest.mark.long),
        pytest.param((effects.FieldDiffusion(kappa=0.7), effects.MagneticAftereffect(share=0.02)), 14, 70.0, 1e-4, marks=pytest.mark.long),
    ],
)
def test_so_they_are_of_many_periods_of_which_few_are_gone_through(held, periods, R_eddy, near):
    """The last period stands for all but the first ones, also where it has settled to rounding long before."""
    found, expected = along_some_directions(*held, periods=periods, R_eddy=R_eddy)
    largest = np.abs(expected).max(axis=1)
    assert largest.min() > 0
    assert np.all(np.abs(found - expected).max(axis=1) < near * largest)


@pytest.mark.long
def test_so_they_are_where_an_effect_reads_the_masses():
    """The slope of the switching is that of all masses over the plane: without it the density's columns are 0.6 % off."""
    found, expected = along_some_directions(effects.RateDependentSwitching(gamma=200.0, of_flux=0.9))
    largest = np.abs(expected).max(axis=1)
    assert largest.min() > 0
    assert np.all(np.abs(found - expected).max(axis=1) < 1e-8 * largest)


@pytest.fixture
def traced(tmp_path, monkeypatch):
    """The names of what is traced and kept."""
    pytest.importorskip("flatbuffers")
    before, names = jax.config.jax_compilation_cache_dir, []
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(programs, "_traced", lambda *a, made=programs._traced: names.append(a[0].__name__) or made(*a))
    programs.forget()
    yield names
    jax.config.update("jax_compilation_cache_dir", before)
    programs.forget()


def test_another_study_asks_for_no_other_programs(traced):
    """Other recordings, as many or more; another density on a plane of the same level; more of an effect's parameters free."""
    actuator = load_bench("aa-050h").actuator()
    lag, detailed = effects.SecondMode(gain=0.01, f2=900.0, xi2=0.05), effects.SecondMode(gain=0.01, f2=900.0, xi2=0.05, lead=0.1)
    assert len(detailed.free_parameters()) > len(lag.free_parameters())
    studies = [
        problem_of(some(20, 200), actuator.with_effect(lag)),
        problem_of(some(30, 70, 150), actuator.with_effect(detailed), knots=(8, 6)),
        problem_of(some(30, 70, 110, 150, 190)),
    ]
    traced.clear()
    for (problem, z), new in zip(
        studies, (["_march", "_read", "marched_steps", "read_rows"], [], ["_read", "read_rows"]), strict=True
    ):
        data_residual(problem, z), data_jacobian(problem, z)
        assert sorted(traced) == new  # the last: of the chain without the effect, whose march is the same
        traced.clear()
    programs.forget()  # as another process
    data_residual(problem, z), data_jacobian(problem, z)
    assert traced == []
    coarse, fine = problem.predictors  # the one of the Jacobian, the other of the residual
    assert np.array_equal(data_residual(problem, z), data_residual(dataclasses.replace(problem, predictors=(fine, fine)), z))
    assert np.array_equal(data_jacobian(problem, z), data_jacobian(dataclasses.replace(problem, predictors=(coarse, coarse)), z))


@pytest.mark.long
def test_nor_does_its_screening(traced, monkeypatch):
    """Of an effect before the hysteresis, one in the source, one behind it."""
    kinds = [effects.SecondEddyPath, effects.AmplifierLag, effects.StrainHysteresis]
    monkeypatch.setattr("fitting.screen.applicable", lambda actuator, quasistatic: kinds)
    few, more = problem_of(some(20, 200)), problem_of(some(30, 70, 150), knots=(8, 6))
    traced.clear()
    found = columns(*few)
    assert {"late_change", "in_step_change", "drive_change"} <= set(traced) and len(found) >= len(kinds)
    traced.clear()
    again = columns(*more)
    assert traced == [] and [row[:2] for row in again] == [row[:2] for row in found]
    assert len(again[0][2]) > len(found[0][2])


@pytest.mark.long
def test_marches_of_many_periods_share_their_programs(traced):
    """How often a period is marched is no number for the compiler, and what is behind the march does not know it."""
    recordings = some(50, 200)
    traced.clear()
    for periods, new in ((3, ["_march", "_read", "marched_steps", "read_rows"]), (8, ["marched_steps"]), (14, [])):
        problem, z = problem_of(recordings, periods=periods)
        found = data_residual(problem, z)
        slopes = data_jacobian(problem, z)
        assert sorted(traced) == new
        traced.clear()
    layout, (coarse, fine) = problem.layout, problem.predictors
    actuator = layout.actuator(problem.template, z)
    assert slopes.shape == (len(found), len(z))
    assert found == pytest.approx(np.asarray(whitened(predicted_lines(fine, actuator), problem.target)), rel=1e-9, abs=1e-9)
    whole = marched_whole(coarse, actuator)
    for M, (_, M_all, _) in zip(problem.passes.magnetizations(z), whole, strict=True):
        M_all = np.asarray(M_all)[1:].reshape(14, -1)
        assert M.shape == (5, M_all.shape[1])
        assert M == pytest.approx(np.concatenate([M_all[:2], M_all[-3:]]), rel=1e-9)
    (_, _, rows), *_ = problem.passes.rows(z)
    for found, expected in zip(zip(*rows.path(), strict=True), whole, strict=True):  # what is screened along, of the same periods
        for row, every in zip(found, expected, strict=True):
            every = np.append(every[:1], every[1:].reshape(14, -1)[[0, 1, 11, 12, 13]])
            assert row == pytest.approx(every, rel=1e-9)


def marched_whole(predictor, actuator):
    """Relay field, M and current of every sample of all periods."""
    (periods,) = predictor.periods

    @jax.jit
    def one(actuator, drive, dt):
        whole = jnp.append(jnp.tile(drive, periods), drive[:1])
        memory = actuator.hysteresis.memory(actuator.hysteresis.table(), predictor.corners)
        found = magnetize(actuator, actuator.coil.applied_field(whole), whole, dt, memory, actuator.coil.scheme, period=len(drive))
        return found[3], found[1], whole

    rows = [one(actuator, *row) for row in zip(predictor.drives[0], predictor.steps[0], strict=True)]
    return [tuple(np.asarray(x) for x in row) for row in rows]
