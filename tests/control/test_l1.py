"""The l1 design against known answers, python-control and its own certificates."""

import ast
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from magjax.control import TrackingProblem, design, optimal_sensitivity
from magjax.control.l1 import knee
from magjax.control.problem import C_W_UM, rod, weight
from magjax.control.realize import Controller, reduced_controller
from magjax.errors import ConfigurationError


def test_the_papers_closed_forms():
    u_star, flat = knee(TrackingProblem())
    assert u_star == pytest.approx(4.097862933, rel=1e-7)
    assert flat == pytest.approx(11.190137818, rel=1e-7)
    beyond = design(TrackingProblem(u_bar=7.5))
    assert beyond.gamma == pytest.approx(flat, rel=1e-7) and beyond.control == pytest.approx(u_star, rel=1e-6)


@pytest.mark.parametrize("u_bar", [0.5, 1.25, 3.25, 4.5])
def test_certified_gap_and_hard_rows(u_bar):
    made = design(TrackingProblem(u_bar=u_bar), taps=40)
    assert 0 <= made.gap <= 1e-6
    assert made.control <= u_bar and made.norms["robust"] <= 1


def test_a_design_takes_less_than_a_third_of_a_second():
    assert min(design(TrackingProblem(), taps=40).seconds for _ in range(8)) < 0.3  # the best of some: other work may be on


def test_gamma_is_monotone_and_falls_by_the_stated_share():
    gammas = [design(TrackingProblem(u_bar=u)).gamma for u in (1.0, 2.0, 3.25, 4.0, 5.0)]
    assert np.all(np.diff(gammas) < 1e-6)
    assert gammas[2] / gammas[-1] - 1 == pytest.approx(0.425, abs=0.002)  # at T = 0.5 ms with the printed constants
    uncertain = [design(TrackingProblem(weight=weight(c * C_W_UM), u_bar=7.5)).gamma for c in (1, 20, 60)]
    noisy = [design(TrackingProblem(w_bar=w)).gamma for w in (0.05, 0.1, 0.2)]
    assert np.all(np.diff(uncertain) > 0) and np.all(np.diff(noisy) > 0)


@pytest.mark.parametrize(
    ("zeros", "poles", "value"),
    [
        ((0,), ("1/2",), Fraction(3)),
        ((0, "1/2"), ("2/3",), Fraction(149, 14)),
        (("1/2",), ("4/5",), Fraction(168, 43)),
        ((0, "1/2"), ("1/5",), Fraction(26)),
    ],
)
def test_pure_sensitivity_is_exact_in_rationals(zeros, poles, value):
    found = optimal_sensitivity(zeros, poles)
    assert found.exact and found.value == value
    points = [Fraction(z) for z in zeros]
    assert all(sum(s * p**k if k else s for k, s in found.S.items()) == 1 for p in points)
    assert all(sum(s * Fraction(p) ** k for k, s in found.S.items()) == 0 for p in poles)


def test_repeated_points_bring_their_derivatives():
    """lambda^2/(1 - 2 lambda): S = 1 + 0 lambda + s2 lambda^2 + ... must vanish at 1/2, so that s2 = -4: 5."""
    found = optimal_sensitivity((0, 0), ("1/2",))
    assert found.exact and found.value == 5 and found.S[2] == -4
    once, twice = optimal_sensitivity((0, "1/2")), optimal_sensitivity((0, "1/2", "1/2"), ("-2/3",))
    assert once.exact and once.value == 1 and twice.exact and twice.value > 1
    slope = sum(k * s * Fraction(1, 2) ** (k - 1) for k, s in twice.S.items() if k)
    assert slope == 0 and sum(s * Fraction(1, 2) ** k for k, s in twice.S.items()) == 1


def test_wrong_interpolation_points_are_refused():
    for zeros, poles, words in (((2,), (), "unit disc"), ((0.5j,), (), "real"), (("1/2",), ("1/2",), "on a zero")):
        with pytest.raises(ConfigurationError, match=words):
            optimal_sensitivity(zeros, poles)


@pytest.mark.parametrize("u_bar", [3.25, 5.0])
def test_reduced_controller_keeps_the_rows_and_python_control_agrees(u_bar):
    from magjax.control.models import rebuilt_norms

    made = design(TrackingProblem(u_bar=u_bar))
    small = reduced_controller(made)
    assert small.order <= 3 and not small.breaks() and small.gamma == pytest.approx(made.gamma, rel=1e-3)
    for controller in (small, Controller(made)):
        rebuilt = rebuilt_norms(controller)
        for name, value in controller.norms.items():
            assert rebuilt[name] == pytest.approx(value, abs=1e-6 * max(1.0, controller.gamma)), name


def test_a_constant_controller_is_realized():
    """At T = 50 ms the rod is at rest between samples: Q is a number."""
    from magjax.control.models import rebuilt_norms

    made = design(TrackingProblem(plant=rod(T=0.05), T=0.05))
    controller = reduced_controller(made)
    assert rebuilt_norms(controller)["error_r"] == pytest.approx(controller.norms["error_r"], abs=1e-6)
    assert design(TrackingProblem(weight=weight(0.0))).gap < 1e-6


def test_margins_say_what_a_delay_does():
    controller = reduced_controller(design(TrackingProblem(u_bar=3.25)))
    margins = controller.margins()
    assert margins.delay == 0 and margins.gain > 2 and margins.phase > 60
    slow = reduced_controller(design(TrackingProblem(u_bar=0.5))).margins()
    assert slow.delay >= 1 and slow.modulus > margins.modulus


def test_closed_loop_by_steps_equals_the_norms():
    """The worst reference of the error row, played through `step`, reaches the l1 norm."""
    made = design(TrackingProblem(u_bar=3.25))
    controller = Controller(made)
    n, d, _ = made.problem.factors()
    from magjax.control.problem import response

    count = 300
    g = response(n, d, count)
    lG = np.concatenate([[0.0, 0.0], g])[:count]
    loop = np.convolve(lG, np.append(made.Q, np.zeros(count)))[:count]
    row = -made.problem.r_bar * loop
    row[2] += made.problem.r_bar
    reference = made.problem.r_bar * np.sign(row[::-1])
    x, errors = np.zeros(len(controller.model[0])), []
    A, B, C, _ = controller.model
    for k in range(count):
        y = float(C[0] @ x)
        u = controller.step(reference[k] - y)
        x = A @ x + B[:, 0] * u
        errors.append((reference[k - 2] if k >= 2 else 0.0) - y)
    assert errors[-1] == pytest.approx(made.norms["error_r"], rel=1e-9)


def test_anti_windup_recovers_sooner():
    made = design(TrackingProblem(u_bar=5.0))
    after = []
    for guarded in (True, False):
        controller = Controller(made)
        A, B, C, _ = controller.model
        x, y = np.zeros(len(A)), []
        for k in range(200):
            reach = 60.0 if k < 60 else 10.0
            out = float(C[0] @ x)
            u = controller.step(reach - out, 0.5, anti_windup=guarded)
            x = A @ x + B[:, 0] * u
            y.append(out)
        after.append(np.abs(np.array(y[70:]) - 10.0).max())
    assert after[0] < 0.3 * after[1]


def test_unstable_plants():
    from magjax.control.models import rebuilt_norms

    plant = (np.array([1.0]), np.array([1.0, -1.5]))
    problem = TrackingProblem(plant=plant, r_bar=1.0, w_bar=0.1, u_bar=6.0, robust=False)
    made = design(problem)
    rebuilt = rebuilt_norms(Controller(made))
    assert rebuilt["error_r"] == pytest.approx(made.norms["error_r"], rel=1e-6) and made.control <= 6.0
    with pytest.raises(ConfigurationError, match=r"smallest feasible u_bar is 3\.63"):
        design(TrackingProblem(plant=plant, r_bar=1.0, w_bar=0.1, u_bar=0.5, robust=False))
    with pytest.raises(ConfigurationError, match="cancelled"):
        design(TrackingProblem(plant=(np.array([1.0, -1.5]), np.convolve([1.0, -1.5], [1.0, -0.5]))))
    with pytest.raises(ConfigurationError, match="unit circle"):
        design(TrackingProblem(plant=(np.array([1.0]), np.array([1.0, -1.0]))))


@pytest.mark.parametrize("numerator", [[1.0, -2.0], [1.0, -2.0, 2.5], [0.0, 1.0, -2.0], [1.0, -1.666666, -5.555555]])
@pytest.mark.parametrize("u_bar", [30.0, np.inf])
def test_plants_with_zeros_inside_the_disc_are_certified_by_interpolation(numerator, u_bar):
    plant = (np.array(numerator), np.array([1.0, -0.5]))
    made = design(TrackingProblem(plant=plant, r_bar=1.0, w_bar=0.05, u_bar=u_bar, robust=False), taps=50)
    assert 0 <= made.gap < 2e-6 and made.control <= u_bar


def test_lower_bound_stays_below_what_longer_controllers_reach():
    for robust in (True, False):
        short = design(TrackingProblem(weight=weight(30 * C_W_UM), robust=robust), taps=12)
        assert (
            short.lower
            <= design(TrackingProblem(weight=weight(30 * C_W_UM), robust=robust), taps=80).gamma
            <= short.gamma * (1 + 1e-7)
        )


def test_interpolation_with_few_taps_leaves_room_for_the_rest():
    """A zero at 0.9: twelve taps see little of it, and the bound must not pretend otherwise."""
    plant = (np.array([0.9, -1.0]), np.array([1.0, -0.5]))
    problem = TrackingProblem(plant=plant, r_bar=1.0, w_bar=2.0, u_bar=np.inf, robust=False)
    short, long = design(problem, taps=12), design(problem, taps=150)
    assert short.lower <= long.gamma and long.gap < 1e-5


UNSTABLE = [
    ([1.0], [1.0, -1.5], 6.0), ([1.0], [1.0, -1.5], np.inf), ([1.0, -2.0], np.convolve([1.0, -1.25], [1.0, -0.3]), 500.0),
    ([1.0, 0.2], np.convolve([1.0, -1.5], [1.0, -1.2]), np.inf), ([1.0, 0.2], [1.0, -1.8353, 1.44], 60.0),
    ([1.0], np.convolve([1.0, -1.3], [1.0, -1.3]), 100.0),
]  # fmt: skip


@pytest.mark.parametrize(("numerator", "denominator", "u_bar"), UNSTABLE)
def test_unstable_plants_are_certified_from_below_too(numerator, denominator, u_bar):
    plant = (np.array(numerator), np.array(denominator))
    problem = TrackingProblem(plant=plant, r_bar=1.0, w_bar=0.1, u_bar=u_bar, robust=False)
    short, made = design(problem, taps=10), design(problem, taps=40)
    assert -1e-9 <= made.gap < 1e-6 and short.lower <= made.gamma * (1 + 1e-9) and short.gamma >= made.lower * (1 - 1e-9)


def test_an_unstable_plant_in_closed_form():
    """g = 1/(1 - 3/2 lambda) without noise: T = lambda^2 X must be 1 at 2/3, so that the least |lambda^2 - T| is 9/4 - 1."""
    plant = (np.array([1.0]), np.array([1.0, -1.5]))
    made = design(TrackingProblem(plant=plant, r_bar=1.0, w_bar=1e-9, u_bar=np.inf, robust=False))
    assert made.gamma == pytest.approx(1.25, rel=1e-7) and made.lower == pytest.approx(1.25, rel=1e-7)


@pytest.mark.parametrize("times", [20, 30, 100])
def test_a_large_uncertainty_is_certified_at_forty_taps(times):
    made = design(TrackingProblem(weight=weight(times * C_W_UM), u_bar=7.5), taps=40)
    assert len(made.Q) == 40 and 0 <= made.gap <= 1e-6 and made.norms["robust"] <= 1


def test_no_jax_behind_inversion_and_control():
    root = Path(__file__).resolve().parents[2] / "magjax"
    for path in [*root.glob("control/*.py"), *root.glob("inverse/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert not {n.split(".")[0] for n in names} & {"jax", "equinox", "optimistix", "fitting"}, path.name


def test_bad_problems_are_told():
    for changed, words in (({"u_bar": -1.0}, "u_bar"), ({"weight": (np.array([1.0]), np.array([1.0, -2.0]))}, "W_0 is unstable")):
        with pytest.raises(ConfigurationError, match=words):
            TrackingProblem(**changed)
    with pytest.raises(ConfigurationError, match="positive"):
        rod(f0=-1)
    for name in ("r_bar", "w_bar", "T", "u_bar"):
        for value in (float("nan"), 0.0, -float("inf")) + (() if name == "u_bar" else (float("inf"),)):
            with pytest.raises(ConfigurationError, match=name):
                TrackingProblem(**{name: value})
    with pytest.raises(ConfigurationError, match="give 4 to 1000"):
        design(TrackingProblem(), taps=10**6)
