"""The coupled step of (4) and the chain: oracle, order, gradients, steady state, bad input, sweep."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from magjax.actuator import Actuator
from magjax.bench import load_bench
from magjax.chain import Coil, FieldCoil, Magnetostriction, Mechanics, Timeline
from magjax.chain.loops import tied
from magjax.chain.march import _march_all, _marched
from magjax.effects.excess_loss import ExcessLoss
from magjax.effects.field_diffusion import FieldDiffusion
from magjax.effects.magnetic_aftereffect import MagneticAftereffect
from magjax.effects.stress_feedback import StressFeedback
from magjax.errors import ConfigurationError
from magjax.preisach import Preisach, gaussian_lorentzian_masses
from magjax.preisach.memory import apply_field
from magjax.simulate import march_chain, march_period, run_chain, simulate, sweep
from tests.oracle.slow import SlowPreisach, slow_trapezoid

LOW, HIGH, M_S = -2500.0, 2.7e4, 7.87e5


def actuator(L=25, **coil):
    masses = gaussian_lorentzian_masses(L, LOW, HIGH, M_S / 2, 9000, 5000, 900, 1100)
    return Actuator(Coil(**coil), Preisach(masses, LOW, HIGH, M_S / 2), Magnetostriction(), Mechanics())


def sine(n, amplitude=0.8, offset=0.1):
    return offset + amplitude * np.sin(2 * np.pi * np.arange(n) / n)


def test_coupled_step_agrees_with_the_slow_one():
    L = 6
    masses = np.asarray(gaussian_lorentzian_masses(L, LOW, HIGH, M_S / 2, 9000, 5000, 900, 1100))
    coil = Coil()
    plain = Actuator(coil, Preisach(masses, LOW, HIGH, 0.0), Magnetostriction(), Mechanics())
    rng = np.random.default_rng(1)
    current = 0.1 + 0.7 * np.sin(np.cumsum(rng.uniform(0, 0.5, 80)))
    c1 = 70.0 / (4e-7 * np.pi * 1300 * 2.83e-5)
    H, M = slow_trapezoid(SlowPreisach(masses, LOW, HIGH), current, 1e-4, 1.54e4, 1.23e4, c1)
    got = simulate(plain, current, 1e-4)
    assert np.abs(np.asarray(got.field) - H).max() < 1e-8
    assert np.abs(np.asarray(got.magnetization) - M).max() < 1e-13 * M_S
    assert np.abs(np.asarray(got.residual)).max() < 1e-8


@pytest.mark.parametrize("scheme", [pytest.param("trapezoid", marks=pytest.mark.long), "bdf2"])
def test_second_order(scheme):
    """Two halvings of the step: the order over a run from rest (kinks fall anywhere between samples, so it scatters)."""
    act = actuator()

    def run(n):
        t = np.arange(n + 1) / n
        current = 0.1 + 0.7 * np.sin(2 * np.pi * t) * np.minimum(t * 4, 1) ** 2
        return np.asarray(simulate(act, current, 1 / (100 * n), scheme=scheme).magnetization)

    best = run(12800)
    errors = [np.sqrt(np.mean((run(n) - best[:: 12800 // n]) ** 2)) for n in (200, 400, 800)]
    order = np.log2(errors[0] / errors[2]) / 2
    assert 1.7 < order < 2.8


STEP = 1e-5  # relative: below it the digits of a sum end, above it samples cross levels, where the second derivative jumps


def test_gradient_in_every_parameter():
    """Forward and reverse mode against central differences, to 1e-7 in every parameter of the chain."""
    act = actuator()
    current = jnp.asarray(sine(120, 0.7))
    weight = jnp.cos(jnp.arange(120.0))
    names, values = zip(*((name, float(value)) for name, (value, _) in act.parameters().items()), strict=True)
    values, units = np.array(values), np.diag(np.maximum(np.abs(values), 1e-6))

    @jax.jit
    def functional(x):
        changed = act.replace(dict(zip(names, x, strict=True)))
        return 1e6 * jnp.sum(weight * run_chain(changed, current, 1 / 12000, 2, 4, "trapezoid").reading)

    push = jax.jit(lambda x, d: jax.jvp(functional, (x,), (d,))[1])
    backward = units @ np.asarray(jax.grad(functional)(values))
    assert len(names) == 11
    for name, unit, reverse in zip(names, units, backward, strict=True):
        forward = float(push(values, unit))
        number = float(functional(values + STEP * unit) - functional(values - STEP * unit)) / (2 * STEP)
        assert forward == pytest.approx(number, rel=1e-7), name
        assert reverse == pytest.approx(forward, rel=1e-9), name


BESIDE = {
    "alone": (),
    "loss and stress": (ExcessLoss(k=20.0), StressFeedback(stiffness=2e7)),
    "after-effect": (MagneticAftereffect(share=0.2),),
}
SAMPLE = {("bdf2", "loss and stress")}


@pytest.mark.parametrize(
    "scheme, effects",
    [
        pytest.param(scheme, effects, id=f"{scheme}, {name}", marks=[] if (scheme, name) in SAMPLE else pytest.mark.long)
        for scheme in ("trapezoid", "bdf2")
        for name, effects in BESIDE.items()
    ],
)
def test_the_replay_has_the_derivatives_of_the_march(scheme, effects):
    """In every number that goes in, with nested loops after a history, effects inside the step and a disturbance."""
    act = actuator(12)
    for effect in effects:
        act = act.with_effect(effect)
    rng = np.random.default_rng(3)
    wave = np.tile(sine(60, 0.5, -0.1) + 0.25 * np.sin(6 * np.pi * np.arange(60) / 60), 2)
    memory = act.hysteresis.memory(act.hysteresis.table(), 12)
    memory = apply_field(act.hysteresis.table(), memory, jnp.asarray(2.2e4))
    given = tuple(jnp.asarray(5.0 * rng.standard_normal(120)) for _ in range(3))
    whole = (act, act.coil.applied_field(jnp.asarray(wave)), jnp.asarray(wave), jnp.asarray(2e-4), memory, given)
    numbers, rest = eqx.partition(whole, lambda x: isinstance(x, jax.Array) and x.dtype == float)
    directions = jax.tree.map(
        lambda x: 1e-3 * jnp.asarray(rng.standard_normal(x.shape)) * (jnp.abs(x) + 1e-3 * jnp.max(jnp.abs(x), initial=0.0)), numbers
    )
    got, direct = (
        jax.jit(lambda x, d, run=run: jax.jvp(lambda x: run(*eqx.combine(x, rest))[:4], (x,), (d,)))(numbers, directions)
        for run in (lambda *x: _marched(scheme, 60, *x), lambda *x: _march_all(scheme, 60, *x))
    )
    for values, changes, value, change in zip(*got, *direct, strict=True):
        assert np.asarray(values) == pytest.approx(np.asarray(value), abs=1e-7)
        assert np.asarray(changes) == pytest.approx(np.asarray(change), rel=1e-9, abs=1e-9 * float(jnp.abs(change).max()) + 1e-9)
    assert float(jnp.abs(direct[1][0]).max()) > 1.0


@pytest.mark.parametrize("effects", [(), (MagneticAftereffect(share=0.2),), (FieldDiffusion(kappa=0.5),)], ids=len)
@pytest.mark.parametrize(("times", "stride"), [(2, 1), (3, 4), (9, 4)])
def test_a_period_by_every_so_many_samples_is_that_of_the_coarser_drive(effects, times, stride):
    """How often it is marched and by how many samples is no number for the compiler."""
    act = actuator(12)
    for effect in effects:
        act = act.with_effect(effect)
    wave, h = jnp.asarray(sine(96, 0.5, -0.1)), 2e-4
    found = march_period_compiled(act, wave, h, np.asarray(times), np.asarray(stride))
    few = wave[::stride]
    expected = jax.jit(lambda a, x: march_chain(a, Timeline(stride * h, len(x), True), x, times, 4)[:3])(act, few)
    for row, value in zip(found, expected, strict=True):
        assert np.asarray(row)[::stride] == pytest.approx(np.asarray(value), rel=1e-10, abs=1e-7)
    H = np.asarray(found[0])
    assert len(H) == 96 and np.count_nonzero(H) == 96 // stride


@eqx.filter_jit
def march_period_compiled(act, wave, h, times, stride):
    return march_period(act, Timeline(h, len(wave), True), wave, times, 4, stride)


def test_gradient_in_the_masses():
    act = actuator(8)
    current = jnp.asarray(sine(100, 0.7))

    @eqx.filter_jit
    def functional(m):
        changed = eqx.tree_at(lambda a: a.hysteresis.masses, act, m)
        return 1e6 * jnp.sum(jnp.sin(jnp.arange(100.0)) * run_chain(changed, current, 1e-4, 2, 4, "trapezoid").reading)

    m = np.asarray(act.hysteresis.masses)
    exact = np.asarray(jax.grad(functional)(jnp.asarray(m)))
    for i, j in ((2, 1), (4, 4), (5, 2)):
        step = STEP * m.max()
        change = np.zeros_like(m)
        change[i, j] = step
        number = float(functional(jnp.asarray(m + change)) - functional(jnp.asarray(m - change))) / (2 * step)
        assert exact[i, j] == pytest.approx(number, rel=1e-7)


def test_periodic_is_the_settled_transient():
    act = actuator()
    n = 400
    steady = simulate(act, sine(n), 1 / (50 * n), periodic=True, settle=4)
    long = simulate(act, np.tile(sine(n), 6), 1 / (50 * n))
    assert np.asarray(long.displacement)[-n:] == pytest.approx(np.asarray(steady.displacement), abs=1e-8)


def test_static_limit_without_eddy_currents():
    masses = gaussian_lorentzian_masses(20, -300, 300, 1e6, 0, 100, 50, 60)
    act = Actuator(FieldCoil(), Preisach(masses, -300, 300, 0.0), output="flux_density")
    field = 250 * np.sin(2 * np.pi * np.arange(200) / 200)
    got = simulate(act, field, 1e-3, periodic=True)
    assert np.asarray(got.field) == pytest.approx(field, abs=1e-9)
    assert np.ptp(np.asarray(got.reading)) > 1.0


@pytest.mark.parametrize(
    ("drive", "dt", "word"),
    [
        ([0.0, np.nan] * 20, 1e-3, "NaN"),
        (np.ones((2, 2)), 1e-3, "one row"),
        (np.zeros(30), -1.0, "positive"),
        (5 * np.sin(np.arange(100) / 5), 1e-3, "outside"),
    ],
)
def test_bad_drive_says_the_mend(drive, dt, word):
    with pytest.raises(ConfigurationError, match=word):
        simulate(actuator(), drive, dt)


def test_sweep_equals_single_runs_and_does_not_depend_on_chunks():
    act = load_bench("aa-050h").actuator()
    grid = dict(frequencies=[10.0, 120.0], amplitudes=[0.3, 0.8], offsets=[0.0])
    one = sweep(act, **grid, chunk=4)
    parts = sweep(act, **grid, chunk=3)
    assert np.allclose(one.peak_to_peak, parts.peak_to_peak, rtol=1e-12)
    n = 250
    alone = simulate(act, 0.8 * np.sin(2 * np.pi * np.arange(n) / n), 1 / (120 * n), periodic=True, tolerance=one.tolerance)
    assert float(one.peak_to_peak.sel(frequency=120, amplitude=0.8).item()) == pytest.approx(
        float(np.ptp(np.asarray(alone.reading))), rel=1e-10
    )
    assert float(one.loss.min()) > 0
    assert one.peak_to_peak.attrs["units"] == "m"


def test_small_loops_and_high_frequencies_are_led_until_they_settle():
    """Two repetitions leave up to 0.4 of the peak to peak there; a large slow loop needs no more than two."""
    act = load_bench("aa-050h").actuator()
    n = 250
    for f, amplitude in ((5, 0.8), (100, 0.05), (400, 0.05), (1000, 0.6)):
        drive, dt = 0.1 + amplitude * np.sin(2 * np.pi * np.arange(n) / n), 1 / (f * n)
        best = simulate(act, drive, dt, periodic=True, settle=120, corners=24)  # extrema that fall by roundings leave corners
        got = simulate(act, drive, dt, periodic=True)
        stroke = float(np.ptp(np.asarray(best.reading)))
        assert np.asarray(got.reading) == pytest.approx(np.asarray(best.reading), abs=3e-7 * stroke)
        assert float(got.unsettled) < 1e-8
        swept = sweep(act, f, amplitude, 0.1, keep=True)
        assert swept.reading.values.ravel() == pytest.approx(np.asarray(best.reading), abs=2e-3 * stroke)
        assert swept.unsettled.item() < swept.tolerance


def test_what_has_not_settled_says_so(monkeypatch):
    monkeypatch.setattr("magjax.simulate.MOST_PERIODS", 3)
    act = load_bench("aa-050h").actuator()
    drive, dt = 0.1 + 0.05 * np.sin(2 * np.pi * np.arange(250) / 250), 1 / (300 * 250)
    assert float(simulate(act, drive, dt, periodic=True).unsettled) == pytest.approx(
        float(simulate(act, drive, dt, periodic=True, settle=2).unsettled), rel=0.2
    )
    swept = sweep(act, [10.0, 300.0], [0.05, 0.8], 0.1)
    assert (swept.unsettled.values > swept.tolerance).ravel().tolist() == [False, False, True, False]


@pytest.mark.parametrize(
    ("grid", "words"),
    [
        (([10.0], [0.5, 5.0]), "at 10 Hz, amplitude 5, offset 0 leads the field to .* outside the Preisach plane"),
        (([10.0], [0.5], [0.0, 2.0]), "offset 2 leads the field"),
        (([10.0, -100.0, 0.0], [0.5]), "frequencies: -100 among them; give numbers above zero"),
        (([np.nan], [0.5]), "frequencies: nan"),
        (([10.0], [np.inf]), "amplitudes: inf"),
        (([], [0.5]), "frequencies: none given"),
    ],
)
def test_a_sweep_refuses_what_a_simulation_refuses(grid, words):
    with pytest.raises(ConfigurationError, match=words):
        sweep(load_bench("aa-050h").actuator(), *grid, samples=60)


def test_a_sweep_tells_a_lost_corner(monkeypatch):
    from magjax import simulate as module

    lost = {"lowest": 1e4, "highest": 1e4, "overflow": True, "peak_to_peak": 1.0}
    monkeypatch.setattr(
        module, "over_devices", lambda run, actuator, rows, **_: {k: np.full(len(rows[0]), v) for k, v in lost.items()}
    )
    with pytest.raises(ConfigurationError, match="amplitude 0.5, offset 0 leaves more than 4 nested corners"):
        sweep(load_bench("aa-050h").actuator(), [10.0], [0.5])


def test_a_loop_that_begins_mapped_is_traced_once_under_vmap():
    """Its body is otherwise gone through again for each part of its carry that turns out to be mapped."""

    def mapped(start_of):
        gone_through = []

        @jax.custom_batching.custom_vmap
        def halved(x):
            return 0.5 * x

        @halved.def_vmap
        def of_all(size, which, x):
            gone_through.append(which)
            return halved(x), True

        def one(x):
            def again(state):
                near, before, number = state
                return halved(near + x), near, number + 1

            return jax.lax.while_loop(lambda s: (s[2] < 9) & (s[1] > -1.0), again, start_of((jnp.zeros(()), jnp.ones(()), 0), x))[0]

        return np.asarray(jax.vmap(one)(jnp.arange(3.0))), len(gone_through)

    plain, often = mapped(lambda start, x: start)
    found, once = mapped(tied)
    assert once == 1 < often and np.array_equal(found, plain)
