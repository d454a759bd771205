"""The Preisach operator: laws of T&B Theorem 2.1, an independent oracle, surrogates, gradients."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magjax.errors import ConfigurationError
from magjax.extrema import nesting, wiped
from magjax.preisach import Preisach, density_masses, forc_masses, relay_magnetization
from magjax.preisach.memory import apply_field
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


@functools.cache
def compiled():
    """M of a field on a plane of level 6, compiled once a length for all examples."""
    operator = Preisach(masses(6), LOW, HIGH)
    return jax.jit(lambda field: operator.magnetization(field, corners=16))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_rate_independence_and_sampling_independence(seed):
    field = random_field(seed, 12)
    fine = np.concatenate([np.linspace(a, b, 5)[1:] for a, b in zip(field[:-1], field[1:], strict=True)])
    coarse = np.asarray(compiled()(field))[1:]
    assert np.abs(np.asarray(compiled()(np.concatenate([field[:1], fine])))[4::4] - coarse).max() < 1e-12


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_piecewise_monotone_and_wiping_out(seed):
    field = random_field(seed, 14)
    M = np.asarray(compiled()(field))
    assert np.all(np.diff(M) * np.sign(np.diff(field)) >= -1e-13)
    # a field beyond all that came before wipes it out
    after = np.asarray(compiled()(np.append(field, HIGH)))[-1]
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


def play_outputs(radii, field):
    """Play operators of these radii from negative saturation, each with its own scalar state: (time, radii)."""
    output, rows = LOW + radii, []
    for H in field:
        output = np.maximum(H - radii, np.minimum(H + radii, output))
        rows.append(output)
    return np.array(rows)


def one_play_a_diagonal(nu, field):
    """M from L plays of radius d cells / 2, each read through one ramp, a cell wide, for each cell of its diagonal."""
    L, width = len(nu), (HIGH - LOW) / len(nu)
    p, M = play_outputs(0.5 * width * np.arange(L), field), np.zeros(len(field))
    for d in range(L):
        for j in range(L - d):
            middle = LOW + width * (j + 0.5 * d)
            M += nu[j + d, j] * (2 * np.clip((p[:, d] - middle) / width, 0, 1) - 1)
    return M


def lines_of_plays(nu, field, q):
    """M of the piecewise-uniform density mu(s, r): exact along s, q plays to half a cell's width of r (midpoints)."""
    L, width = len(nu), (HIGH - LOW) / len(nu)
    mu = 2 * nu / width**2 * (1 + np.eye(L))  # over ds dr; half of a diagonal cell lies below alpha = beta
    dr = 0.5 * width / q
    radii, levels, M = dr * (np.arange(L * q) + 0.5), LOW + width * np.arange(L + 1), 0.0
    for r, p in zip(radii, play_outputs(radii, field).T, strict=True):
        s = np.sort(np.concatenate([levels - r, levels + r]))  # where the line crosses a level of alpha or beta
        s = s[(s > LOW + r - 1e-9) & (s < HIGH - r + 1e-9)]
        centre = 0.5 * (s[1:] + s[:-1])
        cell = [np.clip((x - LOW) // width, 0, L - 1).astype(int) for x in (centre + r, centre - r)]
        below = np.concatenate([[0.0], np.cumsum(mu[*cell] * np.diff(s))])
        M = M + dr * (2 * np.interp(p, s, below) - below[-1])
    return M


def order(sizes, errors):
    """The exponent of errors that fall as a power."""
    return -np.polyfit(np.log(sizes), np.log(errors), 1)[0]


@pytest.mark.parametrize("L", [5, 12])
def test_kp_relays_are_plays(L):
    """The L x L relays of finite slope are L play operators to rounding."""
    field, nu = random_field(9), masses(L, 3)
    got = np.asarray(relay_magnetization(Preisach(nu, LOW, HIGH), field, "kp"))
    assert np.abs(got - one_play_a_diagonal(nu, field)).max() < 2e-15 * nu.sum()


@pytest.mark.parametrize("L", [5, 9])
def test_plays_approach_the_exact_operator_as_their_number_squared(L):
    field, nu, lines = random_field(L), masses(L, L), (2, 4, 8, 16, 32)
    exact = np.asarray(Preisach(nu, LOW, HIGH).magnetization(field, corners=40))
    errors = [np.abs(lines_of_plays(nu, field, q) - exact).max() / nu.sum() for q in lines]
    assert 1.7 < order(lines, errors) < 2.3
    assert np.all(errors * np.square(lines) < 0.15)


def test_relay_grids_approach_the_exact_operator():
    """Point relays jump, and their error falls as 1/L; the finite slope brings 1/L^2."""
    field = np.concatenate([np.linspace(a, b, 100) for a, b in ((LOW, 1500), (1500, -200), (-200, 900), (900, 100))])
    exact, levels = np.asarray(Preisach(smooth(160), LOW, HIGH).magnetization(field)), (10, 20, 40, 80)
    for surrogate, power, scale in (("hard", 1, 2.5), ("kp", 2, 3.0)):
        errors = [np.abs(Preisach(smooth(L), LOW, HIGH).magnetization(field, surrogate) - exact).max() for L in levels]
        assert power - 0.2 < order(levels, errors) < power + 0.2
        assert np.all(errors * np.power(levels, power) < scale)


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

    operator = Preisach(base, LOW, HIGH)

    @jax.jit
    def mean_square(m, shift):
        return jnp.sum(eqx.tree_at(lambda o: o.masses, operator, m).magnetization(field + shift, corners=20) ** 2)

    grad_m, grad_shift = jax.grad(mean_square, argnums=(0, 1))(jnp.asarray(base), 1.234)
    step = 1e-6
    for i, j in ((3, 1), (5, 5), (7, 0)):
        change = np.zeros_like(base)
        change[i, j] = step
        number = (mean_square(jnp.asarray(base + change), 1.234) - mean_square(jnp.asarray(base - change), 1.234)) / (2 * step)
        assert float(grad_m[i, j]) == pytest.approx(float(number), rel=1e-7, abs=1e-9)
    number = (mean_square(jnp.asarray(base), 1.234 + 1e-3) - mean_square(jnp.asarray(base), 1.234 - 1e-3)) / 2e-3
    assert float(grad_shift) == pytest.approx(float(number), rel=1e-7)


def test_lost_corner_is_told():
    nested = np.array([v for k in range(12) for v in (1500 - 100 * k, -900 + 100 * k)])
    operator = Preisach(smooth(20), LOW, HIGH)
    with pytest.raises(Exception, match="nested corners"):
        jax.block_until_ready(operator.magnetization(nested, corners=4))
    assert nesting(nested) >= 12


def test_a_steady_drive_whose_maxima_rounding_lowers_keeps_as_few_corners_as_one_period():
    """A march of 24 periods that had settled before lost its outer corners, and jumped by 125 A/m; the later of two such maxima stands."""
    tops = 1500 * (short := 1 - 1e-14 * np.arange(30))
    drive = np.stack([tops, 200.0 * np.ones(30), 900.0 * np.ones(30), -700 * short], axis=1).ravel()
    operator = Preisach(smooth(20), LOW, HIGH)
    M = np.asarray(operator.magnetization(drive, corners=4)).reshape(30, 4)
    assert np.ptp(M, axis=0).max() < 1e-12 * np.ptp(M)
    memory = operator.memory(table := operator.table(), 4)
    for v in drive[:-3]:
        memory = apply_field(table, memory, v)
    assert [float(m.maxima[0]) for m in (memory, apply_field(table, memory, 0.0))] == [tops[-2], tops[-1]]
    with pytest.raises(Exception, match="nested corners"):  # loops that are open stay
        jax.block_until_ready(operator.magnetization(np.ravel([[1500 - d, d - 700] for d in 1e-3 * np.arange(30)]), corners=4))


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
