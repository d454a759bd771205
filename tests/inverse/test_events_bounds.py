"""Event-by-event integration, the compiled inversion, the bounds of Propositions 4.1-4.3, compensation."""

import dataclasses

import numpy as np
import pytest
from scipy.sparse import csc_array

from magjax.effects import ExcessLoss, QuarticMagnetostriction, SecondMode, SensorLag, TransportDelay
from magjax.errors import ConfigurationError
from magjax.inverse import PlainActuator, PlainPreisach, current_for_displacement, implicit_euler
from magjax.inverse.bounds import backward_bound, forward_bound, simulated_worst, static_bound
from magjax.inverse.dynamic import nearest_feasible
from magjax.inverse.events import HeldCurrent
from magjax.simulate import simulate
from tests.test_simulate import actuator


def plant_with(seed=0, L=25):
    rng = np.random.default_rng(seed)
    masses = np.tril(rng.random((L, L)) * (rng.random((L, L)) > 0.5))
    masses *= 7e5 / masses.sum()
    return PlainActuator(
        PlainPreisach(masses, -3100.0, 27700.0), 70.0, 1.54e4, 1.23e4, 1300, 2.83e-5, 1.313e-3, 7.87e5, 5.13e-2, 392.0, 0.7783
    )


def test_semigroup():
    whole, parts = HeldCurrent(plant_with()), HeldCurrent(plant_with())
    rng = np.random.default_rng(1)
    for _ in range(1500):
        I, h, s = rng.uniform(-1.3, 1.3), 10 ** rng.uniform(-7, -3), rng.uniform()
        whole.advance(I, h)
        parts.advance(I, h * s)
        parts.advance(I, h * (1 - s))
        assert abs(whole.field - parts.field) < 1e-13 * 3e4 * 10
        assert abs(whole.magnetization - parts.magnetization) < 1e-13 * 7.87e5


def test_events_satisfy_the_equation_and_implicit_euler_approaches_them():
    """(4) in integral form over each hold: change of H + M = c1 times the integral of I - (H - H_bias)/c0."""
    plant = plant_with()
    exact = HeldCurrent(plant)
    n, h = 200, 5e-5
    current = 0.6 * np.sin(2 * np.pi * np.arange(n) / n)
    for I in current[:60]:
        before = exact.field + exact.magnetization
        trial = []
        for _ in range(200):
            trial.append(exact.field)
            exact.advance(float(I), h / 200)
        trial.append(exact.field)
        integral = plant.c1 * h * (I - (np.trapezoid(trial) / 200 - plant.H_bias) / plant.c0)
        assert exact.field + exact.magnetization - before == pytest.approx(integral, abs=2e-3 + 2e-4 * abs(integral))
    errors = []
    for m in (1, 4):
        fine = np.repeat(current, m)
        M = implicit_euler(plant, fine, h / m)[1][::m]
        held, reached = HeldCurrent(plant), []
        for I in current:
            held.advance(float(I), h)
            reached.append(held.magnetization)
        errors.append(np.abs(np.array(reached)[:-1] - M[1:]).max())
    assert errors[1] < 0.5 * errors[0]


def test_engine_agrees_with_the_events_to_its_order():
    act = actuator(25)
    plant = PlainActuator.from_actuator(act)
    errors = []
    for n in (200, 400):
        h = 0.02 / n
        t = h * np.arange(n)
        wave = 0.3 * (1 - np.cos(2 * np.pi * 50 * t))
        held, M = HeldCurrent(plant), []
        for k in range(n):
            M.append(held.magnetization)
            held.advance(0.5 * float(wave[k] + wave[min(k + 1, n - 1)]), h)  # held at mid-sample: second order
        errors.append(np.abs(np.asarray(simulate(act, wave, h).magnetization) - M)[: n - 1].max())
    assert errors[1] < 0.35 * errors[0] and errors[0] < 2e-3 * plant.M_s


@pytest.mark.long
def test_compiled_inversion_is_the_same_walk_and_does_not_drift():
    pytest.importorskip("numba")
    from magjax.inverse.accelerated import invert_many

    rng = np.random.default_rng(0)
    a, b = plant_with().operator, plant_with().operator
    targets = rng.uniform(-7.2e5, 7.2e5, 5000)
    assert np.array_equal(a.invert(targets), b.invert(targets, accelerate=True)) and a.extrema == b.extrema
    many = np.clip(rng.uniform(-7.1e5, 7.1e5, 1_000_000), -7e5, 7e5)
    grid = plant_with().operator
    many[:1000] = rng.choice([grid.copy().apply(v) for v in grid.levels], 1000)
    _, values, _, excess = invert_many(grid, many[:-20000])
    assert excess <= 0  # iterations never above n_c + L
    check = plant_with().operator  # its M are computed afresh from the corners left after 980 000 samples
    for field, _ in grid.extrema:
        check.apply(field)
    fields, late, _, excess = invert_many(grid, many[-20000:])
    assert excess <= 0
    assert np.abs(np.concatenate([values, late]) - many).max() < 1e-13 * 7.87e5
    assert np.abs([check.apply(v) for v in fields] - many[-20000:]).max() < 1e-13 * 7.87e5


def test_bounds_hold_and_guard_their_conditions():
    plant = plant_with(L=8)
    h = 1e-3
    back = backward_bound(plant, h)
    assert simulated_worst(plant, h, back.g_bar, trials=6, length=80) <= back.value
    assert backward_bound(plant, h, 0.3 * back.g_bar).value >= back.value
    forward = forward_bound(plant, 1.2e-5)
    assert simulated_worst(plant, 1.2e-5, forward.g_bar, True, trials=4, length=60) <= forward.value
    assert "says nothing" in forward.note
    with pytest.raises(ConfigurationError, match="largest h that holds is 2.034e-05"):
        forward_bound(plant, 5e-5)
    one, two = static_bound(plant, delta_I=0.01), static_bound(plant, delta_I=0.02)
    assert two.value - one.value == pytest.approx(0.01 * plant.operator.total)
    L = plant.operator.cells
    assert static_bound(plant, mass_errors=np.zeros((L, L))).value == pytest.approx(static_bound(plant, delta_I=0.0).value)
    for wrong in ({}, {"delta_I": 0.1, "mass_errors": np.zeros((L, L))}, {"mass_errors": np.zeros((2, 2))}, {"delta_I": -1.0}):
        with pytest.raises(ConfigurationError):
            static_bound(plant, **wrong)


def test_static_bound_covers_a_wrong_density():
    true, L = plant_with(3), 25
    rng = np.random.default_rng(5)
    table = np.tril(np.ones((L, L)))
    from magjax.inverse.bounds import _masses

    masses = _masses(true)
    worst = 0.0
    for _ in range(5):
        wrong = PlainPreisach(masses * (1 + 0.05 * rng.uniform(-1, 1, (L, L)) * table), -3100.0, 27700.0)
        exact = true.operator.copy()
        targets = 0.9 * min(wrong.total, exact.total) * rng.uniform(-1, 1, 200)
        worst = max(worst, max(abs(exact.apply(wrong.solve(float(m))) - m) for m in targets))
    assert 0 < worst <= static_bound(true, delta_I=0.05).value


CASES = [
    (ExcessLoss(k=60.0), False, 0.35),
    (ExcessLoss(k=60.0, rate_knee=10.0, full=1.0), False, 0.1),  # with its detail, without which 0.3 is left, and below 0.18
    (QuarticMagnetostriction(b=0.3), False, 0.35),
    (SecondMode(gain=0.4, f2=600.0, xi2=0.1), False, 0.35),
    (SecondMode(gain=0.4, f2=300.0, xi2=0.1, lead=0.5), False, 0.1),
    (SensorLag(tau=3e-4, order2=0.5), True, 0.35),
    (TransportDelay(tau=3e-4), True, 0.35),
]


@pytest.mark.parametrize(("effect", "of_reading", "left"), [c if i in (1, 4, 5) else pytest.param(*c, marks=pytest.mark.long) for i, c in enumerate(CASES)])
def test_compensation_of_a_repaired_actuator(effect, of_reading, left):
    act = actuator(25)
    repaired = act.with_effect(effect)
    plain, known = PlainActuator.from_actuator(act), PlainActuator.from_actuator(repaired)
    n, h = 2400, 2.5e-5
    t = h * np.arange(n)
    wanted = 28e-6 + 10e-6 * np.sin(2 * np.pi * 50 * t) * np.minimum(1, t / 0.02)
    errors = []
    for model in (plain, known):
        current = current_for_displacement(model, wanted, h, of_reading)[0]
        signals = simulate(repaired, current, h)
        reached = np.asarray(signals.reading if of_reading else signals.displacement)
        errors.append(np.sqrt(np.mean((reached - wanted)[n // 3 : -50] ** 2)))
    assert errors[1] < left * errors[0]


def test_targets_out_of_range_break_the_static_bound():
    plant = plant_with(L=8)
    top = plant.operator.offset + plant.operator.total
    assert static_bound(plant, delta_I=0.01, wanted=[0.0, 0.99 * top]).value > 0
    with pytest.raises(ConfigurationError, match="sample 1 asks"):
        static_bound(plant, delta_I=0.01, wanted=[0.0, 1.01 * top])


@pytest.mark.parametrize("effects", [{}, {"quartic_magnetostriction": {"b": 0.3}}])
def test_nearest_feasible_displacement(effects):
    plant = dataclasses.replace(plant_with(), effects=effects)
    h = 2e-5
    t = h * np.arange(3000)
    stroke = plant.l_rod * plant.lambda_s
    wanted = stroke * (0.5 + 0.3 * np.sin(2 * np.pi * 30 * t) * np.minimum(1, t / 0.02))
    assert np.abs(nearest_feasible(plant, wanted, h) - wanted)[:-5].max() < 2e-3 * stroke
    far = stroke * (0.5 + 0.8 * np.sin(2 * np.pi * 30 * t) * np.minimum(1, t / 0.02))
    offered = nearest_feasible(plant, far, h)
    assert offered.max() < 1.05 * stroke and offered.min() > -0.05 * stroke < np.abs(offered - far).max()


@pytest.mark.parametrize("lead", [0.0, 0.5])
def test_second_mode_of_the_held_plant_is_that_of_the_engine(lead):
    effect = SecondMode(gain=0.15, f2=180.0, xi2=0.1, lead=lead)
    act = actuator(25).with_effect(effect)
    n, h = 4000, 2e-5
    wave = 0.3 * (1 - np.cos(2 * np.pi * 125 * h * np.arange(n)))  # near the second mode
    expected = np.asarray(simulate(act, wave, h).displacement)
    held, got = HeldCurrent(PlainActuator.from_actuator(act), pieces=2), []
    for k in range(n):
        got.append(held.displacement)
        held.hold(0.5 * float(wave[k] + wave[min(k + 1, n - 1)]), h)
    assert np.abs(np.array(got) - expected).max() < 1e-4 * np.ptp(expected)


def test_errors_of_a_fit_in_the_static_bound():
    """Hats with known covariance: masses = total cells @ x, their errors as a Monte Carlo gives them."""
    from types import SimpleNamespace

    from fitting.inversion import inversion_bound, mass_errors

    rng = np.random.default_rng(0)
    act = actuator(25)
    cells = np.tril(np.ones((25, 25))).reshape(-1, 1) * rng.random((625, 3))
    root = rng.standard_normal((4, 4))
    spread = root @ root.T + np.eye(4)
    basis = SimpleNamespace(cells=csc_array(cells))
    layout = SimpleNamespace(density_unknowns=3, hats=SimpleNamespace(size=25), total=2.0, inside=lambda z: z > 0, held=None)
    solution = SimpleNamespace(normal=np.linalg.inv(spread), z=np.ones(4))
    result = SimpleNamespace(problem=SimpleNamespace(layout=layout, basis=basis), solution=solution, actuator=act)
    errors = mass_errors(result)
    draws = 1.3 * 2.0 * rng.multivariate_normal(np.zeros(3), spread[:3, :3], 20000) @ cells.T
    assert errors.ravel() == pytest.approx(draws.std(axis=0), rel=0.05, abs=1e-12)
    held = SimpleNamespace(problem=SimpleNamespace(layout=SimpleNamespace(held=np.ones((25, 25)))))
    assert mass_errors(held).shape == (25, 25) and not mass_errors(held).any()
    bound = inversion_bound(result)
    assert bound.value - static_bound(PlainActuator.from_actuator(act), delta_I=0.0).value == pytest.approx(errors.sum())


def test_names_of_the_plain_actuator():
    assert {f.name for f in dataclasses.fields(PlainActuator)} >= {"R_eddy", "c0", "effects"}


@pytest.mark.parametrize("order2", [0.0, 0.1, 0.25, 0.5])
def test_the_mean_current_behind_an_amplifier_is_its_equation_integrated(order2):
    plant = dataclasses.replace(
        PlainActuator.from_actuator(actuator(8)), effects={"amplifier_lag": {"tau": 3e-4, "order2": order2}}
    )
    events = HeldCurrent(plant, 0.2)
    means = [events._delivered(0.7, 1e-4) for _ in range(6)]
    t = np.linspace(0, 6e-4, 6001)
    poles = np.roots([order2 * 9e-8, 3e-4, 1.0]) if order2 else np.array([-1 / 3e-4])
    a = [1.0] if len(poles) == 1 else [poles[1] / (poles[1] - poles[0]), poles[0] / (poles[0] - poles[1])]
    if len(poles) == 2 and abs(poles[0] - poles[1]) < 1e-3 * abs(poles[0]):
        decay = np.exp(poles[0].real * t) * (1 - poles[0].real * t)
    else:
        decay = sum(c * np.exp(p * t) for c, p in zip(a, poles, strict=True)).real
    exact = 0.7 - 0.5 * decay
    wanted = [np.trapezoid(exact[k * 1000 : (k + 1) * 1000 + 1], dx=1e-7) / 1e-4 for k in range(6)]
    assert np.allclose(means, wanted, rtol=0, atol=1e-7)  # of the trapezoid here
    assert np.isclose(events.amplifier[0], exact[-1], atol=1e-9)
