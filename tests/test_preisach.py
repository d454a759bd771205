"""The Preisach operator: laws of T&B Theorem 2.1, an independent oracle, surrogates, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magjax.errors import ConfigurationError
from magjax.extrema import nesting, wiped
from magjax.preisach import Preisach, density_masses, forc_masses, relay_magnetization
from tests.oracle.slow import SlowPreisach

LOW, HIGH = -1000.0, 2000.0


def masses(L, seed=0):
    rng = np.random.default_rng(seed)
    return np.tril(rng.random((L, L)) ** 2 * (rng.random((L, L)) > 0.3))


def smooth(L):
    return density_masses(lambda s, r: np.exp(-((s - 400) ** 2) / 5e5 - (r / 500) ** 2), L, LOW, HIGH, 1.0)


def random_field(seed, n=60, low=LOW, high=HIGH):
    return np.random.default_rng(seed).uniform(low, high, n)


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_the_slow_operator_to_rounding(seed):
    L = 7
    operator, oracle = Preisach(masses(L, seed), LOW, HIGH), SlowPreisach(masses(L, seed), LOW, HIGH)
    field = random_field(seed, 40)
    field[10], field[20] = LOW + 3 * (HIGH - LOW) / L, HIGH  # on a level, and saturated
    expected = np.array([oracle.apply(v) for v in field])
    got = np.asarray(operator.magnetization(field, corners=24))
    assert np.abs(got - expected).max() < 1e-12 * masses(L, seed).sum()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_rate_independence_and_sampling_independence(seed):
    operator = Preisach(masses(6), LOW, HIGH)
    field = random_field(seed, 12)
    fine = np.concatenate([np.linspace(a, b, 5)[1:] for a, b in zip(field[:-1], field[1:], strict=True)])
    coarse = np.asarray(operator.magnetization(field, corners=16))[1:]
    assert np.abs(np.asarray(operator.magnetization(np.concatenate([field[:1], fine]), corners=16))[4::4] - coarse).max() < 1e-12


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_piecewise_monotone_and_wiping_out(seed):
    operator = Preisach(masses(6), LOW, HIGH)
    field = random_field(seed, 14)
    M = np.asarray(operator.magnetization(field, corners=16))
    assert np.all(np.diff(M) * np.sign(np.diff(field)) >= -1e-13)
    # a field beyond all that came before wipes it out
    after = np.asarray(operator.magnetization(np.append(field, HIGH), corners=16))[-1]
    assert after == pytest.approx(masses(6).sum(), abs=1e-12)


def test_congruent_minor_loops():
    operator = Preisach(smooth(20), LOW, HIGH)
    loop = [0.0, 800.0, 0.0, 800.0]
    one = np.asarray(operator.magnetization(np.array([LOW, *loop])))
    other = np.asarray(operator.magnetization(np.array([LOW, HIGH, *loop])))
    assert np.diff(one[-3:]) == pytest.approx(np.diff(other[-3:]), abs=1e-13)
    assert abs(one[-1] - other[-1]) > 1e-3


def test_lipschitz_bound():
    operator = Preisach(smooth(20), LOW, HIGH)
    L, step = 20, (HIGH - LOW) / 20
    rows = smooth(20)
    # the mass within eps of any memory curve is at most that of a row and a column a cell, per width
    C = (rows.sum(axis=1).max() + rows.sum(axis=0).max()) / step
    field = random_field(3, 200)
    shifted = field + 5.0 * np.sin(np.arange(200))
    a, b = (np.asarray(operator.magnetization(f, corners=40)) for f in (field, shifted))
    assert np.abs(a - b).max() <= 2 * C * 5.0 * L / L


def test_kp_relays_are_plays_and_converge():
    """The finite-slope grid equals its L plays to rounding, and approaches the exact operator as 1/L^2."""
    errors = []
    field = np.concatenate([np.linspace(a, b, 30) for a, b in ((LOW, 1500), (1500, -200), (-200, 900), (900, 100))])
    exact = np.asarray(Preisach(smooth(160), LOW, HIGH).magnetization(field))
    for L in (10, 20, 40):
        errors.append(np.abs(np.asarray(Preisach(smooth(L), LOW, HIGH).magnetization(field, "kp")) - exact).max())
    assert errors[2] < errors[0] / 8
    operator = Preisach(smooth(12), LOW, HIGH)
    got = np.asarray(relay_magnetization(operator, field, "kp"))
    levels = np.linspace(LOW, HIGH, 13)
    state, plays = -np.ones((12, 12)), []
    for v in field:
        ramp = 2 * np.clip((v - levels[:-1]) / np.diff(levels), 0, 1) - 1
        for i in range(12):
            for j in range(12):
                state[i, j] = min(max(state[i, j], ramp[i]), ramp[j])
        plays.append((np.tril(smooth(12)) * state).sum())
    assert got == pytest.approx(np.array(plays), abs=1e-14)


def test_hard_relays_jump_and_converge_as_one_over_L():
    field = np.concatenate([np.linspace(LOW, 1500, 200), np.linspace(1500, -200, 200)])
    exact = np.asarray(Preisach(smooth(160), LOW, HIGH).magnetization(field))
    errors = [np.abs(np.asarray(Preisach(smooth(L), LOW, HIGH).magnetization(field, "hard")) - exact).max() for L in (10, 40)]
    assert 1.5 < errors[0] / errors[1] < 12


def test_start_states():
    def at(start, field=400.0, table=None):
        return float(
            Preisach(smooth(20) if table is None else table, LOW, HIGH, start=start).magnetization(np.array([field]), corners=40)[0]
        )

    low, high = at("negative_saturation"), at("positive_saturation")
    assert high > low + 0.5
    history = [900.0, -100.0]
    led = np.asarray(Preisach(smooth(20), LOW, HIGH).magnetization(np.array([*history, 400.0])))[-1]
    assert at(history) == pytest.approx(led, abs=1e-13)
    # demagnetized: alpha + beta < 0 is up, the rest down; the fine staircase approaches that by areas
    levels = np.linspace(LOW, HIGH, 21)
    s = 0.5 * (levels[:-1, None] + levels[:-1] + (HIGH - LOW) / 20)
    assert at("demagnetized", 0.0) == pytest.approx(-(np.sign(s + 1e-9) * smooth(20)).sum(), abs=0.05)


def test_gradients_equal_differences():
    field = jnp.asarray(random_field(5, 30))
    base = smooth(8)

    def mean_square(m, shift):
        return jnp.sum(Preisach(base, LOW, HIGH).__class__.magnetization(_with(m), field + shift, corners=20) ** 2)

    def _with(m):
        import equinox as eqx

        return eqx.tree_at(lambda o: o.masses, Preisach(base, LOW, HIGH), m)

    grad_m, grad_shift = jax.grad(mean_square, argnums=(0, 1))(jnp.asarray(base), 1.234)
    step = 1e-6
    for i, j in ((3, 1), (5, 5), (7, 0)):
        change = np.zeros_like(base)
        change[i, j] = step
        number = (mean_square(jnp.asarray(base + change), 1.234) - mean_square(jnp.asarray(base - change), 1.234)) / (2 * step)
        assert float(grad_m[i, j]) == pytest.approx(float(number), rel=1e-7, abs=1e-9)
    number = (mean_square(jnp.asarray(base), 1.234 + 1e-4) - mean_square(jnp.asarray(base), 1.234 - 1e-4)) / 2e-4
    assert float(grad_shift) == pytest.approx(float(number), rel=1e-6)


def test_lost_corner_is_told():
    nested = np.array([v for k in range(12) for v in (1500 - 100 * k, -900 + 100 * k)])
    operator = Preisach(smooth(20), LOW, HIGH)
    with pytest.raises(Exception, match="nested corners"):
        jax.block_until_ready(operator.magnetization(nested, corners=4))
    assert nesting(nested) >= 12


def test_reduced_history_keeps_what_matters():
    assert list(wiped([0, 5, 1, 3, 2])) == [0, 5, 1, 3, 2]
    assert list(wiped([0, 5, 1, 3, 2, 4])) == [0, 5, 1, 4]
    assert list(wiped([0, 5, 1, 6])) == [0, 6]


def test_forc_masses_return_the_density():
    L = 10
    truth = smooth(L)
    levels = np.linspace(LOW, HIGH, L + 1)
    curves = np.zeros((L + 1, L + 1))
    for i in range(L + 1):
        down = levels[: i + 1][::-1]
        M = np.asarray(Preisach(truth, LOW, HIGH).magnetization(np.concatenate([[LOW], down])))[1:]
        curves[i, : i + 1] = M[::-1]
    assert forc_masses(curves) == pytest.approx(truth, abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((np.ones((3, 4)), 0, 1), "L x L"),
        ((-np.eye(3), 0, 1), "negative"),
        ((np.eye(3), 1, 0), "low < high"),
        ((np.eye(3), 0, 1, 0, "warm"), "start"),
    ],
)
def test_bad_input_says_the_mend(arguments, word):
    with pytest.raises(ConfigurationError, match=word):
        Preisach(*arguments)
