"""What relays remember that a recording never reaches: start states, the static path, the fit that finds them."""

import dataclasses
import importlib
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.density import hat_basis
from fitting.fit import fit
from fitting.joint import Solution
from fitting.memories import believed, best_memory
from fitting.recipe import lag_recipe
from fitting.setup import Choices
from fitting.starts import unreached_row
from fitting.task import Task
from fitting.told_memory import told_by_checks
from magjax.bench import load_bench
from magjax.errors import ConfigurationError
from magjax.preisach import Preisach, density_masses
from magjax.preisach.static import static_magnetization, static_path, static_value_and_gradient
from magjax.recording import Recording
from magjax.simulate import run_chain, simulate

fit_module = importlib.import_module("fitting.fit")  # not the function
LOW, HIGH, L = -1000.0, 1000.0, 20


def masses_of(seed=0, level=L):
    rng = np.random.default_rng(seed)
    masses = np.tril(rng.random((level, level)))
    return masses / masses.sum()


def loop(amplitude, offset, n=200):
    return offset + amplitude * np.sin(2 * np.pi * np.arange(n + 1) / n)


@pytest.mark.parametrize("rest", [*(pytest.param(r, marks=pytest.mark.long) for r in (0.0, 650.0, -400.0)), 130.0])
@pytest.mark.parametrize(("amplitude", "offset"), [*(pytest.param(*d, marks=pytest.mark.long) for d in ((300.0, 0.0), (300.0, 200.0))), (500.0, -300.0)])
def test_unreached_relays_equal_a_finely_decaying_history(rest, amplitude, offset):
    plain = Preisach(masses_of(), LOW, HIGH)
    rested = Preisach(masses_of(), LOW, HIGH, rest=rest)
    field = np.tile(loop(amplitude, offset), 3)
    heights = max(rest - LOW, HIGH - rest) * (1 - np.arange(300) / 300)
    history = np.clip(rest + heights * (-1.0) ** np.arange(300), LOW, HIGH)
    slow = Preisach(masses_of(), LOW, HIGH, 0.0, np.append(history, rest))
    expected = np.asarray(slow.magnetization(jnp.asarray(field), corners=170))[-100:]
    got = np.asarray(plain.magnetization(jnp.asarray(field)))[-100:] + float(rested.unreached(field.max(), field.min()))
    assert np.abs(got - expected).max() < 5e-3
    assert np.ptp(got - expected) < 1e-12
    written_out = np.asarray(rested.rested(60).magnetization(jnp.asarray(field), corners=50))[-100:]
    assert np.abs(written_out - expected).max() < 4e-2


def test_ends_of_rest_are_the_saturations():
    top, bottom = Preisach(masses_of(), LOW, HIGH, rest=HIGH), Preisach(masses_of(), LOW, HIGH)
    assert float(bottom.unreached(100.0, -100.0)) == 0.0
    field = jnp.asarray(np.tile(loop(300.0, 50.0), 2))
    positive = Preisach(masses_of(), LOW, HIGH, 0.0, "positive_saturation").magnetization(field)[-50:]
    assert np.asarray(bottom.magnetization(field)[-50:] + top.unreached(field.max(), field.min())) == pytest.approx(
        np.asarray(positive), abs=1e-12
    )


def test_rows_of_the_fit_say_the_same():
    basis = hat_basis(-900.0, 900.0, 1.0, 16, 6, 5)
    x = np.random.default_rng(1).random(basis.unknowns)
    operator = Preisach(basis.masses(x), basis.low, basis.high, rest=120.0)
    assert unreached_row(basis, 400.0, -300.0, 120.0) @ x == pytest.approx(float(operator.unreached(400.0, -300.0)), rel=1e-12)


@pytest.mark.parametrize("level", [7, pytest.param(40, marks=pytest.mark.long)])
def test_static_path_is_the_operator_and_its_gradient(level):
    rng = np.random.default_rng(2)
    masses = jnp.asarray(masses_of(3, level))
    fields = (rng.uniform(LOW, HIGH, 300), np.repeat(rng.choice(np.linspace(LOW, HIGH, level + 1), 80), 2), loop(700, 100))
    for field in fields:
        path = static_path(field, LOW)
        got = static_magnetization(masses, LOW, HIGH, 0.1, path)
        assert np.abs(got - Preisach(masses, LOW, HIGH, 0.1).magnetization(field, corners=90)).max() < 1e-13
    run = static_value_and_gradient(lambda M: jnp.sum(M**3), LOW, HIGH, 0.1, path)
    _, gradient = run(masses)
    for cell in ((2, 0), (level - 2, level // 2), (level // 2, level // 2)):
        change = np.zeros((level, level))
        change[cell] = 1e-6
        difference = (run(masses + change)[0] - run(masses - change)[0]) / 2e-6
        assert float(gradient[cell]) == pytest.approx(float(difference), rel=1e-8)
    with pytest.raises(ConfigurationError, match="finite"):
        static_path([0.0, np.nan], LOW)


def recordings_from(start, noise=40e-9, seed=0):
    """Six sines of a smooth bench that began demagnetized about the field at rest."""
    bench = load_bench("aa-050h")
    low, high = -2.9e3, 2.75e4
    masses = density_masses(lambda s, r: np.exp(-(((s - 9e3) / 7e3) ** 2)) / (1 + (r / 7000) ** 2), 60, low, high, 3e5)
    hysteresis = Preisach(masses, low, high, 4e5, rest=start)
    actuator = dataclasses.replace(bench.actuator().replace({"coil.R_eddy": 62.0, "mechanics.xi": 0.8}), hysteresis=hysteresis)
    rng = np.random.default_rng(seed)
    made = []
    for f, A, b in (
        (10, 0.8, 0.1),
        (20, 0.3, -0.4),
        (30, 0.6, 0.2),
        (50, 0.3, 0.4),
        (100, 0.8, 0.0),
        (150, 0.4, -0.3),
        (200, 0.5, 0.2),
        (300, 0.6, -0.1),
    ):
        current = b + A * np.sin(2 * np.pi * np.arange(500) / 500)
        dt = 1 / (f * 500)
        reading = np.tile(np.asarray(run_chain(actuator, jnp.asarray(current), dt, 4, 4).reading), 4)
        channels = {"current": np.tile(current, 4), "displacement": reading + noise * rng.standard_normal(reading.size)}
        made.append(Recording(dt * np.arange(reading.size), channels, {}, {}, f"{f} Hz"))
    return made, bench


@pytest.mark.long
def test_the_fit_finds_a_demagnetized_start():
    made, bench = recordings_from(1.23e4)
    found = fit(made, bench, refine=False)
    assert found.choices.rest == "demagnetized" and found.chi2_per_sample < 1.1
    resistance = found.estimate("coil.R_eddy")
    assert abs(resistance.value - 62.0) < 3 * resistance.stderr + 0.1
    wrong = fit(made, bench, choices=Choices(rest="negative"), refine=False)
    assert wrong.chi2_per_sample > 3


@pytest.mark.long
@pytest.mark.parametrize(("stated", "rest", "found", "told"), [
    ("demagnetized", 0.0, "virgin", False), ("demagnetized", 1.23e4, "demagnetized", False),
    ("positive_saturation", 1.23e4, "demagnetized", True),
])  # fmt: skip
def test_a_start_that_the_bench_states(stated, rest, found, told):
    """A rod is demagnetized with its bias on or before; a start that the recordings contradict is told, and what they say is taken."""
    made, bench = recordings_from(rest)
    result = fit(made, dataclasses.replace(bench, start=stated), refine=False)
    assert result.choices.rest == found and result.chi2_per_sample < 1.1
    assert ("not met from the start that the bench states" in result.message) is told


def test_the_recipe_of_section_2_3():
    actuator = load_bench("aa-050h").actuator()
    made = []
    for f in (20, 60, 120, 250):
        current = 0.1 + 0.8 * np.sin(2 * np.pi * np.arange(800) / 800)
        y = np.tile(np.asarray(simulate(actuator, current, 1 / (800 * f), periodic=True).reading), 2)
        made.append(Recording(np.arange(1600) / (800 * f), {"current": np.tile(current, 2), "displacement": y}, {}, {}, f"{f}"))
    table = lag_recipe(made, actuator, np.arange(50.0, 95.0, 10.0))
    assert table.R_eddy == 70.0 and table.damping_ratio == pytest.approx(0.7783, abs=2e-3)
    assert np.argsort(table.variance)[0] == 2 and table.xi.shape == (5, 4)
    with pytest.raises(ConfigurationError, match="two frequencies"):
        lag_recipe(made[:1], actuator, [60.0, 70.0])
    with pytest.raises(ConfigurationError, match="mesh"):
        lag_recipe(made, actuator, [70.0])


@pytest.mark.parametrize(
    ("ended", "best"),
    [
        ({"demagnetized": (427.3, 981.0), "negative": (462.2, 2.9), "positive": (440.0, 9000.0)}, "negative"),  # a coarse density's misfit
        ({"negative": (1.0, 1.0), "demagnetized": (1.3, 0.0)}, "negative"),  # the noise is met: its harmonics count in full
        ({"negative": (1.0, 400.0), "demagnetized": (1.3, 0.0)}, "demagnetized"),
        ({"negative": (9.0, 0.1), "demagnetized": (1.05, 0.1), "positive": (1.04, 0.1)}, "demagnetized"),  # the first that is settled
        ({"negative": (np.nan, np.nan), "demagnetized": (50.0, 3.0)}, "demagnetized"),
        ({"negative": (np.inf, 0.0)}, "negative"),
    ],
    ids=["coarse", "at the noise", "strained", "settled", "failed", "alone"],
)
def test_the_levels_tell_the_start_memory_where_much_is_amiss(ended, best):
    known = SimpleNamespace(data_count=648, layout=SimpleNamespace(memories=8))

    def row(name, chi2n, strain):
        z = np.append(np.ones(5), np.full(8, np.sqrt(strain)))
        return known, SimpleNamespace(chi2=648 * chi2n, z=z), Choices(rest=name)

    assert best_memory([row(name, *found) for name, found in ended.items()])[2].rest == best


@pytest.mark.parametrize(
    ("stated", "other", "taken"),
    [
        ((1.33, 7965.0), (0.89, 2.5), "demagnetized"),  # positive saturation was stated: met nearly, by levels of micrometres
        ((1.33, 7965.0), (0.89, 60.0), "positive"),  # strained as well
        ((1.33, 7965.0), (1.30, 2.5), "positive"),  # not met
        ((1.33, 8.0), (0.89, 2.5), "positive"),  # what is stated is believed where its levels do not speak against it
        ((1.33, 8.0), (0.89, 1.0), "demagnetized"),  # unless another is calm and met
    ],
    ids=["contradicted", "both strained", "not met", "not contradicted", "settled"],
)
def test_what_the_bench_states_is_believed_unless_its_levels_contradict_it(stated, other, taken):
    known = SimpleNamespace(data_count=648, layout=SimpleNamespace(memories=8))

    def row(name, chi2n, strain):
        z = np.append(np.ones(5), np.full(8, np.sqrt(strain / 8)))
        return known, SimpleNamespace(chi2=648 * chi2n, z=z), Choices(rest=name)

    ended = [row("positive", *stated), row("negative", 5.3, 6549.0), row("demagnetized", *other)]
    assert best_memory(believed(ended, ("positive",)))[2].rest == taken


@pytest.mark.parametrize(
    ("ended", "again", "asked", "best"),
    [  # a null on rough cells, 12 bits: the wrong one was followed, and mean_field named
        ({"negative": (56.5, 0.6), "demagnetized": (23.65, 1014.0), "positive": (23.61, 2147.0)}, (23.58, 0.6), ["negative"], "negative"),
        ({"negative": (56.5, 0.6), "demagnetized": (23.65, 1014.0), "positive": (23.61, 2147.0)}, (60.0, 0.6), ["negative"], "demagnetized"),
        ({"negative": (56.5, 0.6), "demagnetized": (23.65, 1.9), "positive": (23.61, 2147.0)}, None, [], "demagnetized"),  # calm
        ({"negative": (1.0, 0.1)}, None, [], "negative"),
    ],
    ids=["false valley", "not its valley", "calm", "settled"],
)
def test_another_start_memory_is_tried_from_where_a_strained_one_ended(monkeypatch, ended, again, asked, best):
    known = SimpleNamespace(data_count=729, layout=SimpleNamespace(memories=10))

    def row(rest, chi2n, strain):
        z = np.append(np.ones(5), np.full(10, np.sqrt(strain / 10)))
        return known, SimpleNamespace(chi2=729 * chi2n, z=z, interrupted=False), Choices(rest=rest)

    there = []
    monkeypatch.setattr(fit_module, "build_problem", lambda *a: (known, None))
    monkeypatch.setattr(fit_module, "_solved", lambda build, problem, z, tried, *a: row(tried.rest, *ended[tried.rest]))
    monkeypatch.setattr(fit_module, "apart", lambda rests, problem: list(rests))
    monkeypatch.setattr(fit_module, "_from_there", lambda best, rest, *a: there.append(rest) or (lambda say: row(rest, *again)))
    bench = SimpleNamespace(start="auto", drive="current")
    found = fit_module._start_memories(known, None, None, bench, (), Choices(), (), None, lambda *a: None, np.inf)
    assert found[2].rest == best and there == asked


def test_an_interrupt_beside_a_strained_start_memory_keeps_what_was_reached(monkeypatch):
    row = SimpleNamespace(), Solution(*[0.0] * 10, False), Choices(rest="demagnetized")

    def stopped(say):
        raise KeyboardInterrupt

    for runs in ([stopped], [stopped, lambda say: row], [lambda say: (row[0], dataclasses.replace(row[1], interrupted=True), row[2])]):
        ((_, solution, choices),) = fit_module._beside(row, runs, lambda *words: None)
        assert solution.interrupted and not solution.converged and choices.rest == "demagnetized"
    assert fit_module._beside(row, [lambda say: row], lambda *words: None) == [row, row]


def of_memory(rest, chi2, strain=0.1):
    known = SimpleNamespace(data_count=500, layout=SimpleNamespace(memories=4, names=()))
    solution = SimpleNamespace(chi2=chi2, z=np.full(4, np.sqrt(strain / 4)))
    return SimpleNamespace(
        problem=known, solution=solution, chi2_per_sample=chi2 / 500, data_count=500, choices=Choices(rest=rest), actuator=None,
        bench=load_bench("aa-050h"), spectra=(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("others", "says", "more", "told"),
    [
        ({"demagnetized": 500.2, "positive": 506.0}, {"demagnetized": 9.5, "positive": 9.0}, {}, "demagnetized"),
        ({"demagnetized": 500.2, "positive": 506.0}, {"demagnetized": 5.0, "positive": 5.0}, {}, None),  # no strong evidence
        ({"demagnetized": 504.0, "positive": 540.0}, {"demagnetized": 9.0, "positive": 90.0}, {}, None),  # not met as well from there
        ({}, {}, {"missed": False}, None),
        ({}, {}, {"start": "negative_saturation"}, None),
        ({}, {}, {"rest": "negative"}, None),
    ],
    ids=["told", "hardly", "against the recordings", "not missed", "the bench states it", "as given"],
)
def test_check_recordings_tell_a_start_memory_that_those_of_the_fit_do_not(monkeypatch, others, says, more, told):
    """A fit from the wrong one met its noise as well and missed a larger drive by 68 of it."""
    asked, current = [], of_memory("negative", 500.0)

    def fit_or_stop(*a, choices, start, **k):
        asked.append(choices.rest)
        return of_memory(choices.rest, others[choices.rest])

    def foretell(result):
        return SimpleNamespace(whitened=2.0)

    foretell.recordings, foretell.places = ("check",), (0,)
    foretell.says_for = lambda after, before: says[after.choices.rest]
    monkeypatch.setattr("fitting.task.fit_or_stop", fit_or_stop)
    monkeypatch.setattr("fitting.told_memory.apart", lambda rests, problem: list(rests))
    monkeypatch.setattr("fitting.told_memory.missed", lambda *a: more.get("missed", True))
    bench = dataclasses.replace(load_bench("aa-050h"), start=more.get("start", "auto"))
    found = told_by_checks(Task((), bench, Choices(rest=more.get("rest", "auto"))), current, foretell)
    assert (found and found.choices.rest) == told and sorted(asked) == sorted(others)
