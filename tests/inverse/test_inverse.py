"""Exact inversion, the implicit step and the inverse (7), against the operator and against the JAX engine."""

import importlib.util

import numpy as np
import pytest

from magjax.effects import AmplifierLag
from magjax.errors import ConfigurationError
from magjax.inverse import PlainActuator, PlainPreisach, current_for_displacement, implicit_euler
from magjax.inverse.dynamic import feasible_magnetization
from magjax.inverse.events import HeldCurrent
from magjax.preisach import Preisach
from magjax.simulate import simulate
from tests.test_simulate import actuator

LOW, HIGH, L = -1000.0, 1000.0, 20


def random_operator(seed, history=True):
    rng = np.random.default_rng(seed)
    masses = np.tril(rng.random((L, L)) * (rng.random((L, L)) > 0.5))
    masses /= masses.sum()
    grid = np.linspace(LOW, HIGH, L + 1)
    past = np.where(rng.random(8) < 0.4, rng.choice(grid, 8), rng.uniform(LOW, HIGH, 8)) if history else ()
    return PlainPreisach(masses, LOW, HIGH, 0.0, past), masses, past


@pytest.mark.parametrize("seed", range(6))
def test_streaming_operator_equals_the_engine(seed):
    plain, masses, past = random_operator(seed)
    field = np.random.default_rng(seed + 100).uniform(LOW, HIGH, 50)
    got = np.array([plain.apply(v) for v in field])
    expected = np.asarray(Preisach(masses, LOW, HIGH).magnetization(np.concatenate([past, field]), corners=40))[len(past) :]
    assert np.abs(got - expected).max() < 1e-13


@pytest.mark.parametrize("seed", range(10))
def test_inversion_is_exact_and_within_its_iterations(seed):
    plain, masses, _ = random_operator(seed)
    rng = np.random.default_rng(seed)
    check = plain.copy()
    for _ in range(1000):
        kind = rng.random()
        target = plain.magnetization if kind < 0.05 else rng.uniform(-0.999, 0.999)
        before = plain.corners
        field = plain.solve(target)
        assert plain.iterations <= before + L
        assert abs(plain.magnetization - target) < 1e-13
        assert abs(check.apply(field) - target) < 1e-13


def test_many_random_cases_with_every_edge():
    """Grid lines, corners, no move, tiny moves, saturation; planes with empty and with wildly uneven cells."""
    rng = np.random.default_rng(7)
    done = 0
    while done < 20000:
        cells = int(rng.integers(1, 30))
        masses = np.tril(rng.random((cells, cells)))
        kind = rng.integers(4)
        masses *= (rng.random(masses.shape) > (0.0, 0.5, 0.9, 0.0)[kind]) * (
            np.exp(8 * rng.standard_normal(masses.shape)) if kind == 3 else 1.0
        )
        if masses.sum() == 0:
            continue
        plain = PlainPreisach(masses / masses.sum(), LOW, HIGH)
        for v in np.where(rng.random(9) < 0.5, rng.choice(plain.levels, 9), rng.uniform(LOW, HIGH, 9)):
            plain.apply(v)
        check = plain.copy()
        for q in rng.random(20):
            probe = plain.copy()
            if q < 0.25:
                target = probe.apply(rng.choice(plain.levels))
            elif q < 0.4:
                target = plain.extrema[rng.integers(len(plain.extrema))][1]
            elif q < 0.5:
                target = rng.choice([-1.0, 1.0, -1.1, 1.1])
            else:
                target = plain.magnetization + 10 ** rng.uniform(-16, 0) * rng.choice([-1.0, 1.0])
            before = plain.corners
            field = plain.solve(target)
            wanted = min(max(target, -1.0), 1.0)
            assert plain.iterations <= before + cells
            assert abs(plain.magnetization - wanted) < 1e-13 and abs(check.apply(field) - wanted) < 1e-13
            assert plain.saturated or abs(target) <= 1 + 1e-13
            done += 1


def test_saturation_and_plateaus_are_told():
    plain = PlainPreisach(np.eye(4) / 4, 0.0, 4.0)
    plain.solve(2.0)
    assert plain.saturated and plain.magnetization == pytest.approx(1.0)
    plain.solve(-3.0)
    assert plain.saturated and plain.corners == 0
    gap = lambda *history: PlainPreisach(np.diag([0.5, 0.0, 0.5]), 0.0, 3.0, history=history)  # nothing switches between 1 and 2
    up, down, stays, inside = gap(), gap(3.0), gap(1.5), gap()
    assert (up.solve(0.0), up.unique) == (1.0, False)  # from below the nearest of all the fields that give M = 0
    assert (down.solve(0.0), down.unique) == (2.0, False)
    assert (stays.solve(0.0), stays.unique) == (1.5, False)
    assert inside.solve(0.25) > 2 and inside.unique and inside.solve(-0.25) < 1 and inside.unique
    inside.invert([0.3, 0.0, -0.3, 0.0, 2.0])
    assert inside.ambiguous_at.tolist() == [False, True, False, True, False] and inside.saturated_at.tolist() == 4 * [False] + [
        True
    ]
    smooth = PlainPreisach(np.tril(np.ones((4, 4))), 0.0, 4.0)
    assert all(smooth.solve(m) is not None and smooth.unique for m in (smooth.copy().apply(1.0), 3.0, smooth.copy().apply(2.0)))
    with pytest.raises(ConfigurationError, match="monotone"):
        PlainPreisach(-np.eye(3), 0, 1)


def test_implicit_step_and_inverse_are_exact():
    plant = PlainActuator.from_actuator(actuator(25))
    h, n = 1e-4, 400
    current = 0.1 + 0.6 * np.sin(2 * np.pi * np.arange(n) / 150)
    H, M = implicit_euler(plant, current, h)
    residual = np.diff(H + M) - h * plant.c1 * (current[1:] - (H[1:] - plant.H_bias) / plant.c0)
    assert np.abs(residual).max() < 1e-14 * plant.M_s
    back = np.concatenate([[0.0], np.diff(H + M)]) / h / plant.c1 + (H - plant.H_bias) / plant.c0
    again = implicit_euler(plant, back, h)[1]
    assert np.abs(again - M).max() < 1e-13 * plant.M_s


def test_engine_approaches_the_implicit_steps():
    act = actuator(25)
    plant = PlainActuator.from_actuator(act)
    errors = []
    for n in (400, 1600):
        current = 0.1 + 0.6 * np.sin(2 * np.pi * np.arange(n) / n) * (1 - np.cos(2 * np.pi * np.arange(n) / n))
        M = implicit_euler(plant, current, 0.02 / n)[1]
        errors.append(np.abs(np.asarray(simulate(act, current, 0.02 / n).magnetization) - M).max())
    assert errors[1] < 0.4 * errors[0] < 0.02 * plant.M_s


@pytest.mark.parametrize("order2", [0.0, 0.25])
def test_open_loop_tracking(order2):
    """The current for a wanted displacement makes the simulated actuator follow it."""
    act = actuator(25)
    plant = PlainActuator.from_actuator(act)
    n, h = 2000, 5e-5
    t = h * np.arange(n)
    wanted = 30e-6 + 12e-6 * np.sin(2 * np.pi * 20 * t)
    current, infeasible, saturated = current_for_displacement(plant, wanted, h)
    assert not infeasible.any() and not saturated.any()
    y = np.asarray(simulate(act, current, h).displacement)
    assert np.abs(y - wanted)[n // 4 :].max() < 0.3e-6
    import dataclasses

    late = dataclasses.replace(plant, effects={"amplifier_lag": {"tau": 2e-4, "order2": order2}})
    behind = act.with_effect(AmplifierLag(tau=2e-4, order2=order2))
    for model, better in ((plant, False), (late, True)):
        error = np.asarray(simulate(behind, current_for_displacement(model, wanted, h)[0], h).displacement) - wanted
        assert (np.abs(error[n // 4 : -20]).max() < 0.3e-6) == better
    if importlib.util.find_spec("numba"):
        assert np.array_equal(current_for_displacement(plant, wanted, h, accelerate=True)[0], current)
    far, infeasible, _ = current_for_displacement(plant, 3 * wanted, h)
    assert infeasible.any() and np.all(np.isfinite(far))


def test_free_displacement_of_a_sine_is_that_of_the_rod():
    """u = y''/w0^2 + 2 xi y'/w0 + y of (5), for a sine in closed form."""
    plant = PlainActuator.from_actuator(actuator(12))
    stroke, w, h = plant.l_rod * plant.lambda_s, 2 * np.pi * 60.0, 1e-5
    t = h * np.arange(4000)
    wanted = stroke * (0.5 + 0.2 * np.sin(w * t))
    M, wrong = feasible_magnetization(plant, wanted, h)
    r = w / (2 * np.pi * plant.f0)
    u = 0.5 + 0.2 * ((1 - r * r) * np.sin(w * t) + 2 * plant.xi * r * np.cos(w * t))
    assert not wrong.any() and np.abs((M / plant.M_s) ** 2 - u)[3:-3].max() < 1e-5


def test_invert_command_offers_the_nearest_and_refuses_uneven_time(tmp_path, capsys):
    from magjax.cli import main

    t = 1e-4 * np.arange(600)
    far = 33.0 + 60.0 * np.sin(2 * np.pi * 20 * t) * np.minimum(1, t / 0.02)
    uneven = t.copy()
    uneven[300] += 5e-5
    for name, time, wanted in (("far", t, far), ("near", t, 33.0 + 0.1 * (far - 33.0)), ("uneven", uneven, far)):
        np.savetxt(
            tmp_path / f"{name}.csv", np.stack([time, wanted], axis=1), delimiter=",", header="time_s,displacement_um", comments=""
        )
    out = tmp_path / "current.csv"
    assert main(["invert", str(tmp_path / "far.csv"), "--out", str(out)]) == 0
    assert "not feasible" in capsys.readouterr().out and out.read_text().startswith("time_s,current_A,displacement_m")
    assert main(["invert", str(tmp_path / "near.csv"), "--out", str(out)]) == 0
    assert out.read_text().startswith("time_s,current_A\n")
    assert main(["invert", str(tmp_path / "uneven.csv"), "--out", str(out)]) == 3
    assert "not uniform at sample 300" in capsys.readouterr().err


def test_what_is_no_number_is_refused_and_the_memory_kept():
    nan = float("nan")
    plain, _, _ = random_operator(3)
    plain.solve(0.3)
    before = list(plain.extrema)
    for ask in (
        lambda: plain.solve(nan),
        lambda: plain.apply(nan),
        lambda: plain.solve(0.5, -1.0),
        lambda: plain.invert([0.1, nan]),
    ):
        with pytest.raises(ConfigurationError, match="NaN|number"):
            ask()
    assert plain.extrema == before
    for masses, low, high in (
        (np.full((3, 3), nan), 0, 1), (np.ones((3, 3)), 0, 1), (np.ones(3), 0, 1), (np.zeros((0, 0)), 0, 1), (np.eye(3), 1, 0), (np.eye(3), 0, nan),
    ):  # fmt: skip
        with pytest.raises(ConfigurationError, match="give numbers|L x L|give low < high"):
            PlainPreisach(masses, low, high)
    plant = PlainActuator.from_actuator(actuator(12))
    for wanted, h in (
        ([1e-5, nan, 1e-5, 1e-5], 1e-4),
        ([1e-5] * 4, nan),
        ([1e-5] * 4, 0.0),
        ([1e-5], 1e-4),
        (np.ones((4, 4)), 1e-4),
    ):
        with pytest.raises(ConfigurationError, match="sample time|four samples"):
            current_for_displacement(plant, wanted, h)
    held = HeldCurrent(plant)
    for current, duration in ((nan, 1e-4), (0.1, nan), (0.1, -1.0), (np.inf, 1e-4)):
        with pytest.raises(ConfigurationError, match="give numbers"):
            held.hold(current, duration)
    if importlib.util.find_spec("numba"):
        with pytest.raises(ConfigurationError, match="at sample 1"):
            plain.invert([0.1, nan], accelerate=True)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("time_s,displacement_m\n" + "".join(f"{k}e-4,{30 + k}\n" for k in range(9)), "if the column is in um"),
        ("time_s,displacement_um\n" + "".join(f"{k}e-4,-30\n" for k in range(9)), "no sample can be reached"),
        ("time_s,displacement_um\n" + "".join(f"{9 - k}e-4,30\n" for k in range(9)), "does not run forward"),
        ("time_s,displacement_um\n0,30\nnan,30\n2e-4,30\n3e-4,30\n", "no gaps in time"),
        ("time_s,displacement_um\n0,30\n1e-4,nan\n2e-4,30\n3e-4,30\n", "no gaps in time or displacement"),
        ("time_s,colour\n0,1\n1,2\n", "no displacement column"),
        ("time_s,displacement_um\n", "no samples"),
        ("", "no header row"),
        (bytes(range(256)), "cannot be read as CSV"),
        (None, "cannot be read as CSV"),
    ],
)
def test_a_bad_trajectory_is_one_line_and_writes_nothing(tmp_path, capsys, content, words):
    from magjax.cli import main

    path = tmp_path / "w\u00e4nted.csv"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert main(["invert", str(path), "--out", str(tmp_path / "current.csv")]) == 3
    text = capsys.readouterr().err
    assert words in text and text.count("\n") == 1 and [f.name for f in tmp_path.iterdir()] == [path.name]


def test_a_trajectory_is_read_by_the_benchs_names(tmp_path):
    from magjax.bench import load_bench
    from magjax.inverse.command import read_trajectory

    path = tmp_path / "wanted.csv"
    path.write_text("t,gap\n" + "".join(f"{k},{30 + k}\n" for k in range(9)))
    (tmp_path / "b.toml").write_text(
        '[columns.time]\nname = "t"\nunit = "ms"\n[columns.displacement]\nname = "gap"\nunit = "um"\nscale = -1\n'
    )
    columns = load_bench(tmp_path / "b.toml").columns
    time, wanted = read_trajectory(path, columns)
    assert time == pytest.approx(1e-3 * np.arange(9)) and wanted == pytest.approx(-1e-6 * (30 + np.arange(9)))
    path.write_text("time_s,displacement_um\n" + "".join(f"{k}e-3,{30 + k}\n" for k in range(9)))  # the usual names serve, too
    assert read_trajectory(path, columns)[1] == pytest.approx(1e-6 * (30 + np.arange(9)))


def test_what_is_not_compensated_is_named(tmp_path, capsys, monkeypatch):
    import magjax.inverse.command as command
    from magjax.bench import load_bench
    from magjax.cli import main
    from magjax.effects import Backlash, SensorLag

    known = actuator(12).with_effect(AmplifierLag(tau=1e-4)).with_effect(SensorLag(tau=1e-4)).with_effect(Backlash())
    monkeypatch.setattr(command, "load_actuator", lambda bench, model: (known, load_bench("aa-050h")))
    t = 1e-4 * np.arange(300)
    wanted = np.stack([t, 33.0 + 3.0 * np.sin(2 * np.pi * 20 * t) * np.minimum(1, t / 0.02)], axis=1)
    np.savetxt(tmp_path / "w.csv", wanted, delimiter=",", header="time_s,displacement_um", comments="")
    for options, left in (([], ["backlash", "sensor_lag"]), (["--of-reading"], ["backlash"])):
        assert main(["invert", str(tmp_path / "w.csv"), "--out", str(tmp_path / "c.csv"), *options]) == 0
        assert f"not compensated: {', '.join(left)}" in capsys.readouterr().out
