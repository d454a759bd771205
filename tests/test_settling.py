"""As many periods as it takes: a rod that lags by more than a period is fitted settled."""

import dataclasses
import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.check import check_errors
from fitting.demo import record
from fitting.fit import fit
from fitting.model import Target, predicted_lines
from fitting.settling import LADDER, left, periods_asked
from fitting.setup import Choices, build_problem, spectra_of
from fitting.task import Task
from magjax.bench import load_bench


def problem(magnetizations, *periods, misfit=0.0):
    """Of 1000 numbers, read with a fundamental of 1e4 deviations, so that 3e-4 of it is 3 of these."""
    lines = np.full((len(periods), 2), 1e4 + 0j)
    return SimpleNamespace(
        predictors=[SimpleNamespace(periods_of_each=periods)], data_count=1000, target=SimpleNamespace(lines=lines, deviations=np.ones(lines.shape)),
        passes=SimpleNamespace(magnetizations=lambda z: magnetizations, residual=lambda z: np.array([misfit])),
    )  # fmt: skip


def settling(periods, first, falls):
    """A loop of height 1 that is off by `first` in its first period, and by `falls` times as much in each one after."""
    loop = 0.5 * np.sin(2 * np.pi * (np.arange(50) + 0.5) / 50)
    return loop + first * falls ** np.arange(periods)[:, None]


@pytest.mark.parametrize(("periods", "first", "falls", "asked"), [
    (3, 0.01, 0.1, 3), (3, 0.01, 0.5, 8), (5, 0.01, 0.6, 8), (8, 0.01, 0.5, 8), (3, 1.0, 0.5, 14), (8, 0.1, 0.6, 14), (8, 0.01, 0.9, 24), (24, 1.0, 0.9, 24), (40, 1.0, 0.9, 40),
    (2, 1e-4, 0.1, 2), (2, 1e-3, 0.1, 8),
])  # fmt: skip
def test_as_many_periods_as_it_takes_until_a_recording_is_settled(periods, first, falls, asked):
    """After 3, 1e-2 times 0.5^2 is left, after 8 1e-2 times 0.5^7, which is less than 3e-4."""
    assert periods_asked(problem([settling(periods, first, falls)], periods), None) == (asked,)


def test_what_is_left_is_more_than_the_last_change_where_it_falls_slowly():
    """0.9 of it by a period: nine times the last change, not a little more than it."""
    off, falls = left(settling(12, 0.01, 0.9))
    assert off == pytest.approx(0.01 * 0.9**11, rel=1e-6) and falls == pytest.approx(0.9)
    assert off > 8 * 0.01 * (0.9**10 - 0.9**11)


def test_a_loop_without_height_is_settled():
    """What is left of rounding is no loop that moves; and no loop is farther off than its height."""
    assert left(5e5 + 1e-10 * np.random.default_rng(0).standard_normal((3, 50)))[0] < 1e-5
    assert left(np.array([[0.0, 1.0], [9.0, 9.1], [5e2, 5e2 + 0.1]]))[0] == 1.0


def test_the_fast_ones_keep_the_least_and_the_slow_ones_share_the_most():
    """As many grids as there are numbers of periods: two."""
    rows = [settling(3, 1e-9, 0.1), settling(8, 1e-9, 0.1), settling(8, 0.1, 0.9), settling(3, 0.1, 0.5)]
    assert periods_asked(problem(rows, 3, 8, 8, 3), None) == (3, 24, 24, 24)


@pytest.mark.parametrize(("chi2", "asked"), [(1e3, 8), (7.9e3, 8), (8.1e3, 3), (1e9, 3)])
def test_what_is_left_must_count_beside_the_misfit(chi2, asked):
    """7 in ten thousand of 1e4 deviations, twice for the square law: 200 of chi2. Near enough to the noise, it is that which counts."""
    off = 1e-3 * np.sqrt(0.5)
    row = settling(3, 4 * off, 0.5)
    assert left(row)[0] == pytest.approx(off)
    assert periods_asked(problem([row], 3, misfit=np.sqrt(chi2)), None) == (asked,)
    assert periods_asked(problem([row], 3), None, chi2) == (asked,)


@pytest.mark.long
def test_recordings_of_different_periods_in_one_fit():
    """Each is predicted and differentiated as by itself, in the order that they came in."""
    bench, rng = load_bench("aa-050h"), np.random.default_rng(3)
    truth = bench.actuator().replace({"coil.R_eddy": 20.0})
    recordings = [record(truth, f, 0.6, 0.1, rng, f"{f:g} Hz") for f in (200.0, 20.0, 120.0)]
    each = (4, 2, 4)
    posed = [
        build_problem(spectra_of(recordings, bench), truth, bench, ("coil.R_eddy", "mechanics.f0"), Choices(periods=n, rest="negative"))
        for n in (each, 2, 4)
    ]
    mixed, two, four = (p.passes for p, _ in posed)
    z = posed[0][1]
    assert mixed.problem.predictors[0].periods_of_each == each
    assert [len(m) for m in mixed.magnetizations(z)] == list(each)
    lines, fewer, more = (p.lines(z, p.problem.predictors[1]) for p in (mixed, two, four))
    assert np.allclose(lines[[0, 2]], more[[0, 2]], rtol=1e-12, atol=0) and np.allclose(lines[1], fewer[1], rtol=1e-12, atol=0)
    assert not np.allclose(fewer[0], more[0], rtol=1e-6, atol=0)
    whole = predicted_lines(mixed.problem.predictors[0], mixed.problem.layout.actuator(mixed.problem.template, z))
    assert np.allclose(mixed.lines(z, mixed.problem.predictors[0]), whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max())
    width = mixed.problem.target.lines.shape[1]
    J, slow = mixed.jacobian(z), four.jacobian(z)
    for k, of in ((0, slow), (1, two.jacobian(z)), (2, slow)):
        rows = np.concatenate([k * width + np.arange(width), 3 * width + k * (width - 1) + np.arange(width - 1)])
        assert np.allclose(J[rows], of[rows], rtol=1e-9, atol=1e-9 * np.abs(J).max())


def test_an_interrupt_while_periods_are_told_keeps_what_was_reached(monkeypatch):
    module = importlib.import_module("fitting.fit")
    stopped = SimpleNamespace(interrupted=True, z=np.ones(3), chi2=5.0)
    monkeypatch.setattr(module, "periods_asked", lambda *_: (8,))
    monkeypatch.setattr(module, "_weights", lambda *_: None)
    monkeypatch.setattr(module, "solve", lambda problem, z, weights, **more: stopped)
    longer = problem([], 8)
    ended = module._solved(lambda choices: (longer, np.zeros(3)), problem([], 3), np.zeros(3), Choices(), None, np.inf, lambda *_: None)
    assert ended[0] is longer and ended[1] is stopped and ended[2].periods == (8,)


@pytest.mark.parametrize(
    ("converged", "patient", "target", "periods"),
    [(False, True, np.inf, (8,)), (False, False, np.inf, (3,)), (True, False, np.inf, (8,)), (False, False, 4.0, (8,)), (True, True, 2.0, (3,))],
    ids=["patient", "not", "converged", "near its target", "far from it"],
)
def test_a_trial_that_used_up_its_jacobians_waits_until_it_is_of_use(monkeypatch, converged, patient, target, periods):
    """An amplifier's limit took 30 Jacobians of 3, 17 of 8 and 30 of 24 periods to end at four times what its rival met at once. An after-effect
    ended at 11 with 3 periods, above a rival's 8, and at 2.4 with 8."""
    module = importlib.import_module("fitting.fit")
    monkeypatch.setattr(module, "periods_asked", lambda *_: (8,))
    monkeypatch.setattr(module, "_weights", lambda *_: None)
    monkeypatch.setattr(
        module, "solve", lambda problem, z, weights, **more: SimpleNamespace(interrupted=False, converged=converged, z=np.ones(3), chi2=5.0)
    )
    given = problem([], 3), np.zeros(3), Choices(periods=(3,)), SimpleNamespace(problem=None, solution=SimpleNamespace(z=np.zeros(3)))
    monkeypatch.setattr(module, "_density", lambda start: None)
    ended = module._solved(lambda *_: (problem([], 8), np.zeros(3)), *given, target, lambda *_: None, patient)
    assert ended[2].periods == periods


def test_a_rod_that_lags_by_more_than_a_period(monkeypatch):
    """4 ohm: after three periods M still moves at 300 Hz, and no density makes up for it."""
    bench, rng = load_bench("aa-050h"), np.random.default_rng(5)
    truth = bench.actuator().replace({"coil.R_eddy": 4.0})
    drives = ((20.0, 0.8, 0.1), (120.0, 0.7, 0.0), (300.0, 0.5, 0.3))
    recordings = [record(truth, *drive, rng, f"{drive[0]:g} Hz") for drive in drives]
    near = dataclasses.replace(bench, constants={**bench.constants, "coil.R_eddy": 5.0})
    found = fit(recordings, near, choices=Choices(fine=250), refine=False)
    assert max(found.choices.periods) in LADDER[1:] and found.chi2_per_sample < 1.2
    resistance = found.estimate("coil.R_eddy")
    assert abs(resistance.value - 4.0) < 3 * resistance.stderr + 0.02
    row = check_errors(found.actuator, found.actuator, [record(truth, *drives[2], rng, "check")], bench)[0]
    assert row["rms_after"] < 2.5 * row["noise_rms"]
    with monkeypatch.context() as patched:
        patched.setattr(importlib.import_module("fitting.fit"), "periods_asked", lambda problem, *_: problem.predictors[0].periods_of_each)
        short = fit(recordings, near, choices=Choices(fine=250), refine=False)
    assert short.chi2_per_sample > 1.5 * found.chi2_per_sample
    for target, longer in ((np.inf, True), (1.0, False)):  # a fit that goes on from it, and one that is of no use
        again = fit(recordings, near, actuator=short.actuator, choices=short.choices, start=short, refine=False, target=target)
        assert (np.max(again.choices.periods) > 3) == longer
        assert (again.chi2_per_sample < 0.7 * short.chi2_per_sample) == longer


@pytest.mark.parametrize(
    ("chi2n", "few", "periods"), [(1200.0, 1300.0, 3), (1200.0, 4e5, (3, 24)), (1200.0, np.nan, (3, 24)), (2.0, 2.0, (3, 24))],
    ids=["physics is missing", "after three far from settled", "after three nothing", "near the noise"],
)
def test_a_fit_that_goes_on_from_a_model_led_astray_begins_with_the_fewest_periods(monkeypatch, chi2n, few, periods):
    """A plain fit of a rod in shells at 1272 times its noise was led to a loss that took 24 periods; with these every later fit took its time.
    One of 96 ohm was off by 4e5 times its noise after three, and most of each later fit went to that."""
    begun, asked = [], []

    @dataclasses.dataclass
    class Predictor:
        periods: tuple

    def lines(z, predictor):
        asked.append(predictor.periods)
        return np.array([[0.0, 0.0, np.sqrt(10 * few) + 0j]])

    monkeypatch.setattr("fitting.task.fit_or_stop", lambda *given, **how: begun.append(how["choices"].periods))
    target = Target(np.zeros((1, 3)), np.ones((1, 3)), None, None, None, np.zeros((1, 3)), np.zeros((1, 1)))
    problem = SimpleNamespace(predictors=(None, Predictor((2, 24))), passes=SimpleNamespace(lines=lines, target=target))
    start = SimpleNamespace(
        chi2_per_sample=chi2n, data_count=10, choices=Choices(periods=(3, 24)), spectra=(), problem=problem, solution=SimpleNamespace(z=None)
    )
    task = Task((), None)
    task.fit_on(start)
    task.fit_on(start, choices=start.choices)  # as it is told
    assert begun == [periods, (3, 24)] and set(asked) <= {(2, 3)}
