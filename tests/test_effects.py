"""One table over the whole catalogue: identity at null, gradients, batching, declared facts."""

import collections
import dataclasses
import re
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import jv

import magjax.effects as effects
from fitting.attribute import _further_starts
from fitting.screen import shape_grid
from magjax.acquire.response import effect_of
from magjax.chain import BLOCKS, Timeline, newton
from magjax.chain.march import magnetize
from magjax.chain.mechanics import Mechanics
from magjax.effects import CATALOGUE, AbstractEffect
from magjax.effects.base import Trial
from magjax.effects.field_diffusion import ZEROS, DiffusionModes
from magjax.errors import ConfigurationError
from magjax.simulate import run_chain, simulate
from tests.test_simulate import actuator, sine

Rates = collections.namedtuple("Rates", "flux_rate")
N = 160
CURRENT = jnp.asarray(sine(N, 0.7))
DT = 1 / (80 * N)
FORMS = [form for kind in CATALOGUE for form in kind.forms]
named = pytest.mark.parametrize("kind", CATALOGUE, ids=lambda k: k.name)
SAMPLE = ("amplifier_lag", "excess_loss", "strain_hysteresis")  # before, in and behind the step


@eqx.filter_jit
def reading(act, current=CURRENT):
    return run_chain(act, current, DT, 2, 4, "trapezoid").reading


def test_every_effect_is_in_the_catalogue():
    defined = {
        v for v in vars(effects).values() if isinstance(v, type) and issubclass(v, AbstractEffect) and v is not AbstractEffect
    }
    assert defined == set(CATALOGUE)
    assert len({k.name for k in CATALOGUE}) == len(CATALOGUE) >= 29


@named
def test_declares_what_the_documentation_needs(kind):
    assert kind.block in BLOCKS and kind.law and kind.source and kind.signature
    assert kind.parameters()[kind.amplitude].null == 0.0
    assert kind.__doc__ and kind.__module__.endswith(kind.name)


@pytest.mark.long
def test_at_their_nulls_all_of_them_together_change_nothing():
    act, base = actuator(20), np.asarray(reading(actuator(20)))
    for kind in CATALOGUE:
        act = act.with_effect(kind())
    assert len(act.effects) == len(CATALOGUE)
    assert np.abs(np.asarray(reading(act)) - base).max() <= 2e-15 * np.abs(base).max()


@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=[] if k.name in SAMPLE else pytest.mark.long, id=k.name) for k in CATALOGUE]
    + [pytest.param(k, id=f"{k.name}: {k.__name__}") for k in FORMS],
)
def test_null_gradient_and_batch(kind):
    act = actuator(20)
    extended = act.with_effect(kind())
    base = np.asarray(reading(act))
    # the same to the last bit but for the compiler's fused multiply-adds
    assert np.abs(np.asarray(reading(extended)) - base).max() <= 2e-15 * np.abs(base).max()
    name, scale = f"effects.{kind.name}.{kind.amplitude}", kind.parameters()[kind.amplitude].scale

    value, step = 0.3 * scale, 1e-4 * scale
    finite = kind.finite_trials([CURRENT], [CURRENT], [DT])
    if finite:  # no derivative at null: where it acts
        extended = act.with_effect(kind(**finite[-1]))
        value = finite[-1][kind.amplitude]

    @jax.jit
    @jax.vmap
    def readings_and_slopes(value, current):
        return jax.jvp(lambda v: reading(extended.replace({name: v}), current), (value,), (jnp.ones_like(value),))

    drives = jnp.stack([CURRENT, CURRENT, CURRENT, 0.5 * CURRENT])
    values = value + step * jnp.asarray([0.0, 1.0, -1.0, 0.0])
    program = readings_and_slopes.lower(values, drives)
    # no batch of matrices for LAPACK, see `magjax.linear`
    assert not re.findall(r"custom_call @lapack_\w+.*?: \(tensor<4x\d+x\d+x", program.as_text())
    found, slopes = map(np.asarray, program.compile()(values, drives))
    number = (found[1] - found[2]) / (2 * step)
    assert np.abs(number).max() > 0
    assert np.abs(slopes[0] - number).max() < 2e-4 * np.abs(number).max()
    assert found[3] == pytest.approx(np.asarray(reading(extended.replace({name: value}), 0.5 * CURRENT)), abs=1e-16, rel=1e-9)


def test_the_modes_of_a_solid_rod_are_those_of_its_bessel_functions():
    """Applied field less mean B over mu is k s mean B F(s), and H / mean B = x J0(x) / (2 J1(x)) at the surface, x^2 = -8 s T with the
    mean lag T; the modes beyond the sixth follow at once."""
    act = actuator(20).replace({"coil.R_eddy": 60.0}).with_effect(DiffusionModes(kappa=1.0, tau=6e-4))
    T = 6e-4 * ZEROS[0] ** 2 / 8
    found, n = run_chain(act, CURRENT, DT, 6, 8), np.arange(1, 6)
    opposing = np.fft.rfft(np.asarray(act.coil.applied_field(found.current) - found.field))[n]
    late = opposing / (float(act.coil.loss) * 2j * np.pi * 80.0 * n * np.fft.rfft(np.asarray(found.flux_density))[n])
    s = 2j * np.pi * 80.0 * n
    x = np.sqrt(-8 * s * T)
    whole = (x * jv(0, x) / (2 * jv(1, x)) - 1) / (s * T)
    assert np.abs(late - whole)[::2].max() < 0.02 and np.abs(whole)[4] < 0.8
    half = run_chain(act.replace({"effects.field_diffusion.kappa": 0.5}), CURRENT, DT, 6, 8)
    opposing = np.fft.rfft(np.asarray(act.coil.applied_field(half.current) - half.field))[n]
    part = opposing / (float(act.coil.loss) * 2j * np.pi * 80.0 * n * np.fft.rfft(np.asarray(half.flux_density))[n])
    assert np.abs(part - (1 + late) / 2)[::2].max() < 0.01
    ladder = run_chain(act.replace({"effects.field_diffusion.nearer": 0.8}), CURRENT, DT, 6, 8)
    opposing = np.fft.rfft(np.asarray(act.coil.applied_field(ladder.current) - ladder.field))[n]
    late = opposing / (float(act.coil.loss) * 2j * np.pi * 80.0 * n * np.fft.rfft(np.asarray(ladder.flux_density))[n])
    modes = 8 / ZEROS**2 / (1 + s[:, None] * 6e-4 * (ZEROS[0] / ZEROS) ** 1.2)
    assert np.abs(late - (1 - np.sum(8 / ZEROS**2) + modes.sum(axis=1)))[::2].max() < 0.01


def test_a_form_of_a_law_is_told_by_its_parameters():
    assert effects.form_of("field_diffusion", ("kappa", "tau")) is DiffusionModes
    assert effects.form_of("field_diffusion", ()) is effects.form_of("field_diffusion", ("kappa",)) is effects.FieldDiffusion
    assert effects.form_of("second_mode", ("tau",)) is effects.SecondMode and effects.forms_of("second_mode") == (effects.SecondMode,)
    assert type(effect_of("field_diffusion", {"tau": 2e-4})) is DiffusionModes
    with pytest.raises(ConfigurationError, match="it has kappa, alike or kappa, tau"):
        effect_of("field_diffusion", {"tau": 2e-4, "alike": 1.0})
    assert all(form.name == kind.name and form.block == kind.block for kind in CATALOGUE for form in kind.forms)


def test_a_strain_that_lags_along_the_path_of_m():
    """Plays on M/M_s of a closed loop, what they lag added to the free displacement, not squared with M."""
    rod, line = actuator(20).magnetostriction, Timeline(DT, N, True)
    m = 0.4 + 0.3 * np.sin(2 * np.pi * np.arange(N) / N)
    u = jnp.asarray(float(rod.reach) * m**2)

    def strained(**how):
        return np.asarray(effects.StrainHysteresis(share=0.1, width=0.2, **how).strain(u, jnp.asarray(m) * rod.M_s, None, line, actuator(20)))

    late = np.zeros(N)
    for width in (0.02, 0.06, 0.12, 0.2):
        state = m[0]
        for _ in range(2):
            path = []
            for now in m:
                state = min(max(state, now - width), now + width)
                path.append(state)
        late += np.asarray(path) / 4
    dahl, before, path = 0.0, m[0], []
    for now in np.concatenate([m, m]):  # the steps between two samples, in small ones
        for _ in range(2000):
            moved = (now - before) / 2000
            dahl += moved - abs(moved) * dahl / 0.1
        path, before = [*path, dahl], now
    assert strained(of_m=1.0, smooth=1.0) - np.asarray(u) == pytest.approx(-0.1 * float(rod.reach) * np.asarray(path[N:]), rel=1e-3, abs=1e-10)
    assert strained(of_m=1.0) - np.asarray(u) == pytest.approx(0.1 * float(rod.reach) * (late - m), abs=1e-15)
    half = (strained(of_m=1.0) + strained()) / 2
    assert strained(of_m=0.5) == pytest.approx(half, abs=1e-15) and np.abs(half - strained()).max() > 1e-7


def test_forms_that_are_far_from_null_are_tried_too():
    """Of a solid rod the shells are scored; where they leave a misfit its modes are fitted, and not these twice. A strain that lags is
    scored along either path."""
    (modes,) = effects.FieldDiffusion().elsewhere(actuator(20))
    assert type(modes) is DiffusionModes and modes.kappa > 0.5 and not modes.elsewhere(actuator(20))
    trial = SimpleNamespace(name="field_diffusion", result=SimpleNamespace(actuator=actuator(20).with_effect(effects.FieldDiffusion())))
    base = SimpleNamespace(actuator=actuator(20))
    assert (DiffusionModes, base) in [(type(effect), of) for effect, of in _further_starts(base, trial)]
    grid = shape_grid(effects.StrainHysteresis)
    assert {g["of_m"] > 0.5 for g in grid} == {True, False} and all(0 < g["smooth"] < 1 for g in grid)


def test_effects_act_in_the_order_of_the_catalogue_however_they_are_added():
    pair = (effects.Backlash(gap=3e-7), effects.DuffingStiffness(k3=0.05))
    one, other = actuator(20), actuator(20)
    for first, second in zip(pair, pair[::-1], strict=True):
        one, other = one.with_effect(first), other.with_effect(second)
    assert [e.name for e in one.effects] == [e.name for e in other.effects] == ["duffing_stiffness", "backlash"]
    assert np.array_equal(np.asarray(reading(one)), np.asarray(reading(other)))
    again = one.with_effect(effects.DuffingStiffness(k3=0.1))
    assert [e.name for e in again.effects] == ["duffing_stiffness", "backlash"] and float(again.effects[0].k3) == 0.1


@pytest.mark.parametrize("linkage", [pytest.param(0.0, marks=pytest.mark.long), 4e-3])
def test_a_limited_voltage_bounds_the_current(linkage):
    command, limit = np.asarray(CURRENT), 0.6
    effect = effects.AmplifierClipping(inverse_limit=1 / limit, tau_L=2e-3, linkage=linkage)
    act = actuator(20).with_effect(effect)
    found = run_chain(act, CURRENT, DT, 8, 4)
    current, B = np.asarray(found.current), np.asarray(found.flux_density)
    voltage = current + 2e-3 * (current - np.roll(current, 1)) / DT + linkage * (B - np.roll(B, 1)) / DT
    assert np.abs(voltage).max() == pytest.approx(limit, rel=1e-5) and np.abs(command).max() > 0.65
    free = np.abs(voltage) < limit * (1 - 1e-4)
    assert 0.05 < free.mean() < 0.95 and np.abs(current - command)[free].max() < 1e-12
    # the field is that of this current: without the effect, driven by it
    alone = run_chain(dataclasses.replace(act, effects=()), found.current, DT, 8, 4)
    assert np.abs(np.asarray(found.field - alone.field)).max() < 1e-6 * np.ptp(np.asarray(alone.field))
    other = run_chain(act.replace({"effects.amplifier_clipping.linkage": 0.0}), CURRENT, DT, 4, 4).current
    assert (linkage > 0) == (np.abs(current - np.asarray(other)).max() > 1e-3)


def test_a_round_limit_is_a_hyperbola_about_the_hard_one():
    command, limit = np.asarray(CURRENT), 0.6
    delivered = [
        np.asarray(run_chain(actuator(20).with_effect(effects.AmplifierClipping(inverse_limit=1 / limit, tau_L=0.0, softness=s)), CURRENT, DT, 4, 2).current)
        for s in (0.0, 1e-6, 0.1)
    ]  # fmt: skip
    u = command / limit
    assert np.abs(u).max() > 1.1 and np.array_equal(delivered[0], np.clip(command, -limit, limit))
    assert np.abs(delivered[1] - delivered[0]).max() < 1e-6 * limit
    assert delivered[2] == pytest.approx(limit * (np.hypot(u + 1, 0.1) - np.hypot(u - 1, 0.1)) / 2, abs=1e-12)


def test_the_mean_of_accommodation_follows_the_path_of_the_magnetization():
    """da = p (m - a) |dm|, exactly, along two loops of m of another size; at pace 0 it moves at reversals alone."""
    from magjax.effects.base import Trial

    act = actuator(20)
    M_s = float(act.strained.M_s)

    def means(effect, m):
        at = lambda x: Trial(x, x * M_s, 0.0, 0.0, 0.0, 1e-3)
        state, found = effect.start(at(m[0]), act), []
        for x in m[1:]:
            state = effect.advance(at(x), state, act)
            found.append(float(state[0]))
        return np.asarray(found)

    m = np.concatenate([np.linspace(0, 0.6, 200), np.linspace(0.6, -0.2, 300)[1:], np.linspace(-0.2, 0.5, 200)[1:]])
    exact, a = [], 0.0
    for m0, m1 in zip(m[:-1], m[1:], strict=True):  # of a line of m along the path s
        sign, p, s = np.sign(m1 - m0), 0.7, abs(m1 - m0)
        settled = lambda m: m - sign / p
        a = settled(m1) + (a - settled(m0)) * np.exp(-p * s)
        exact.append(a)
    assert means(effects.Accommodation(shift=100.0, pace=0.7), m) == pytest.approx(exact, abs=1e-5)
    plain = means(effects.Accommodation(shift=100.0), m)
    assert len(np.unique(plain)) == 3 and plain[-1] == pytest.approx(0.85 * 0.15 * m[200] + 0.15 * m[499], abs=1e-12)


@pytest.mark.parametrize("softness", [0.0, 1e-6])
def test_a_supply_of_two_unlike_voltages_limits_each_sign_by_its_own(softness):
    command, limit, uneven = np.asarray(CURRENT), 0.6, 0.15
    effect = effects.AmplifierClipping(inverse_limit=1 / limit, tau_L=0.0, softness=softness, unevenness=uneven)
    delivered = np.asarray(run_chain(actuator(20).with_effect(effect), CURRENT, DT, 4, 2).current)
    exact = np.clip(command, -(1 - uneven) * limit, (1 + uneven) * limit)
    assert command.max() > 1.1 * (1 + uneven) * limit and command.min() < -1.1 * (1 - uneven) * limit
    assert np.abs(delivered - exact).max() < 1e-6 * limit


@pytest.mark.parametrize(
    "f,v_s,presliding,stribeck,tolerance",
    [(4e-7, 1e-7, 3e-7, 0, 0.02), (4e-7, 1e-7, 2e-6, 0, 0.02), (4e-7, 1e-3, 1e-8, 0, 0.03), (2e-6, 1e-5, 1e-7, 0, 0.02)]
    + [(4e-7, 1e-7, 1e-6, 0.5, 0.02)],
    ids=["Dahl", "Dahl wide", "viscous", "sticks", "LuGre"],
)
def test_friction_against_its_equation_in_time(f, v_s, presliding, stribeck, tolerance):
    from scipy.integrate import solve_ivp

    act = actuator(20)
    effect = effects.CoulombFriction(f=f, v_s=v_s, presliding=presliding, stribeck=stribeck, v_stribeck=2e-3)
    signals = simulate(act.with_effect(effect), CURRENT, DT, periodic=True)
    free = np.asarray(signals.free_displacement)
    w, xi = 2 * np.pi * float(act.mechanics.f0), float(act.mechanics.xi)
    times = DT * np.arange(4 * N + 1)
    pull = lambda t: np.interp(t, times, np.append(np.tile(free, 4), free[0]))

    def rate(t, state):
        y, v, p = state
        top = 1 + stribeck * np.exp(-((v / 2e-3) ** 2))
        return [v, w * w * (pull(t) - y - f * p) - 2 * xi * w * v, (abs(v) + v_s) * (np.tanh(v / v_s) - p / top) / presliding]

    exact = solve_ivp(rate, (0, times[-1]), [free[0], 0, 0], "LSODA", times, rtol=1e-7, atol=1e-12, max_step=DT).y[0, 3 * N : 4 * N]
    without = np.asarray(simulate(act, CURRENT, DT, periodic=True).displacement)
    rms = lambda a: np.sqrt(np.mean(a**2))
    assert rms(np.asarray(signals.displacement) - exact) < tolerance * rms(without - exact)
    record = simulate(act.with_effect(effect), jnp.tile(CURRENT, 3), DT, periodic=False)  # from rest, as a whole record
    assert rms(np.asarray(record.displacement)[2 * N :] - np.asarray(signals.displacement)) < 2 * tolerance * rms(without - exact)


@pytest.mark.parametrize("effect", [
    effects.DuffingStiffness(k3=2.0, k5=0.2, rest=0.1), effects.DuffingStiffness(k3=-0.15), effects.DeltaE(e=0.8, static=0.7, bend=0.6), effects.DeltaE(e=-0.5),
], ids=["stiffens", "softens", "gives way", "stays"])  # fmt: skip
@pytest.mark.parametrize("periodic", [True, False])
def test_a_strong_spring_of_a_lightly_damped_rod_against_its_equation_in_time(effect, periodic):
    """Its stiffness changes by several times the damping ratio: there a fixed point swings up."""
    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

    act = actuator(20).replace({"mechanics.f0": 1500.0, "mechanics.xi": 0.1})
    reach, f, n, turns = float(act.strained.reach), 250.0, 512, 1 if periodic else 4
    line = Timeline(jnp.asarray(1 / (f * n)), turns * n, periodic)
    times = np.arange(turns * n) / (f * n)

    def free(t):
        return reach * (0.35 + 0.3 * np.sin(2 * np.pi * f * t) + 0.02 * np.cos(4 * np.pi * f * t))

    def square(t):
        return 0.4 + 0.3 * np.sin(2 * np.pi * f * t - 0.4)

    if effect.name == "delta_e":
        stiffer = lambda t: float(effect.e) * square(t) * (1 + float(effect.bend) * (1 - square(t)))
        force = lambda t, y: -stiffer(t) * (y - (1 - float(effect.static)) * free(t))
    else:
        ratio = lambda y: y / reach - float(effect.rest)
        force = lambda t, y: -reach * float(effect.k3) * ratio(y) ** 3 * (1 + float(effect.k5) * ratio(y) ** 2)
    given = jnp.asarray(free(times))
    signals = {"magnetization": act.magnetostriction.M_s * jnp.sqrt(jnp.asarray(square(times)))}
    found = effect.displacement(act.mechanics(given, line), given, signals, line, act)
    rest = brentq(lambda y: y - free(0) - force(0, y), -2 * reach, 2 * reach)
    w0, start = 2 * np.pi * 1500.0, 30 / f if periodic else 0.0

    def rate(t, state):
        y, v = state
        return v, w0**2 * (free(t) + force(t, y) - y) - 2 * 0.1 * w0 * v

    exact = solve_ivp(
        rate, (0, start + times[-1]), [rest, 0], "LSODA", start + times, rtol=1e-9, atol=1e-15, max_step=1 / (50 * f)
    ).y[0]
    assert np.abs(exact - np.asarray(act.mechanics(given, line))).max() > 0.01 * np.ptp(exact)  # it does change the motion
    assert np.abs(np.asarray(found) - exact).max() < (1e-6 if periodic else 1e-4) * np.ptp(exact)


@pytest.mark.long
def test_a_rod_that_sticks_stays_calm_on_a_coarse_grid():
    act = dataclasses.replace(actuator(20), mechanics=Mechanics(jnp.asarray(400.0), jnp.asarray(0.1)))
    effect = effects.CoulombFriction(f=1.2e-6, v_s=1e-6, presliding=1.5e-7)

    def lost(count):  # 10 Hz; at 125 samples hardly three a swing of the rod
        line = Timeline(jnp.asarray(0.1 / count), count, True)
        turn = 2 * jnp.pi * jnp.arange(count) / count
        pull = 2e-5 * jnp.sin(turn) + 6e-6 * jnp.sin(2 * turn + 1)
        linear = line.filter(pull, act.mechanics.response)
        return np.asarray(effect.displacement(linear, pull, None, line, act) - linear)[:: count // 125]

    coarse, fine = lost(125), lost(2000)
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.04 * np.sqrt(np.mean(fine**2))


@pytest.mark.long
@pytest.mark.parametrize("frequency", [10.7, 175.0])
def test_strong_friction_of_a_little_damped_rod_is_settled(frequency, monkeypatch):
    """The rod goes on swinging after each turn: a slow drive's samples are too few for it, a fast one's period too short."""
    from magjax.effects import coulomb_friction as module

    act = dataclasses.replace(actuator(20), mechanics=Mechanics(jnp.asarray(500.0), jnp.asarray(0.055)))
    effect = effects.CoulombFriction(f=3.7e-6, v_s=1e-6, presliding=4e-7)

    def lost(count):
        line = Timeline(jnp.asarray(1 / (frequency * count)), count, True)
        turn = 2 * jnp.pi * jnp.arange(count) / count
        linear = line.filter(1.5e-5 * (jnp.sin(turn) + 0.3 * jnp.sin(2 * turn + 1)), act.mechanics.response)
        return np.asarray(effect.displacement(linear, None, None, line, act) - linear)[:: count // 500]

    found = lost(500)
    monkeypatch.setattr(module, "PASSES", 16)
    true = lost(8000)
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.005 * np.sqrt(np.mean(true**2))


@pytest.mark.parametrize(
    "effect",
    [
        effects.ExcessLoss(k=80.0, rate_knee=0.1), effects.StressFeedback(stiffness=3e11),
        *(
            pytest.param(effect, marks=pytest.mark.long)
            for effect in (effects.RateDependentSwitching(gamma=60.0, rate0=1e3), effects.MagneticAftereffect(share=0.1), effects.MeanField(alpha=8e-3))
        ),
    ],
    ids=lambda e: e.name,
)  # fmt: skip
def test_steps_with_an_effect_settle_as_bracketed_ones_do(effect, monkeypatch):
    """Newton's method for what the effect adds, and the bracket that is there where this does not settle."""
    act = actuator(20).with_effect(effect)

    def march():
        found = jax.jit(lambda current: run_chain(act, current, DT, 2, 4))(CURRENT)
        return np.asarray(found.field), np.asarray(found.residual)

    H, left = march()
    monkeypatch.setattr(newton, "MOST_LINEAR", 0)
    bracketed, left_there = march()
    plain = np.asarray(run_chain(actuator(20), CURRENT, DT, 2, 4).field)
    assert np.abs(H - plain).max() > 1.0
    assert np.abs(H - bracketed).max() < 5e-5 and max(np.abs(left).max(), np.abs(left_there).max()) < 5e-5  # of 1e4 A/m


@pytest.mark.parametrize("frequency", [pytest.param(40.0, marks=pytest.mark.long), 175.0])
def test_the_derivative_of_friction_is_that_of_all_passes(frequency):
    """By the force, its presliding, the rod and the drive: it is taken from the last pass and what that makes of a period's begin."""
    act = dataclasses.replace(actuator(20), mechanics=Mechanics(jnp.asarray(500.0), jnp.asarray(0.055)))
    line = Timeline(jnp.asarray(1 / (frequency * 500)), 500, True)
    turn = 2 * jnp.pi * jnp.arange(500) / 500

    @jax.jit
    def moved(change):
        rod = act.replace({"mechanics.f0": 500.0 * (1 + change[2]), "mechanics.xi": 0.055 * (1 + change[2])})
        effect = effects.CoulombFriction(f=2e-6 * (1 + change[0]), v_s=1e-4, presliding=4e-7 * (1 + change[1]))
        linear = line.filter(1.5e-5 * (jnp.sin(turn) + (0.3 + change[3]) * jnp.sin(2 * turn + 1)), rod.mechanics.response)
        return effect.displacement(linear, None, None, line, rod) - linear

    slopes = np.asarray(jax.jacfwd(moved)(jnp.zeros(4)))
    for k, slope in enumerate(slopes.T):
        h = 1e-5 * jnp.eye(4)[k]
        expected = np.asarray(moved(h) - moved(-h)) / 2e-5
        assert np.sqrt(np.mean((slope - expected) ** 2)) < 2e-3 * np.sqrt(np.mean(expected**2))


def test_creep_weighs_its_lags_by_a_power_of_time():
    line, signal = Timeline(jnp.asarray(1e-3), 200, True), jnp.sin(2 * jnp.pi * jnp.arange(200) / 200)  # 5 Hz
    s = 2j * np.pi * 5
    for exponent in (0.0, 0.3, -0.3):
        effect = effects.Creep(gain=0.1, shortest=2e-3, exponent=exponent)
        got = np.fft.rfft(np.asarray(effect.displacement(signal, signal, None, line, None)))[1] / np.fft.rfft(np.asarray(signal))[1]
        tau = np.logspace(np.log10(2e-3), 2, 20001)
        lost = np.trapezoid((tau / 0.1) ** exponent * s * tau / (1 + s * tau), np.log10(tau))
        assert got == pytest.approx(1 - 0.1 * lost, abs=1e-5)
        if exponent == 0:
            assert lost == pytest.approx(-np.log10((1 + s * 2e-3) / (1 + s * 100)), rel=1e-6)


def test_structural_damping_is_a_solid_of_many_relaxations_from_the_mean_to_the_resonance():
    """Maxwell branches spread evenly over the logarithm of time up to 3 s: K = K0 (1 + g ln(1 + 3 s)), the mean at rest in K0."""
    rod, longest, g = actuator(20).replace({"mechanics.f0": 500.0, "mechanics.xi": 0.2}), 3.0, 0.01
    w0, dt = 2 * np.pi * 500.0, 1e-3
    line, signal = Timeline(jnp.asarray(dt), 200, True), 2.0 + jnp.sin(2 * jnp.pi * jnp.arange(200) / 200)  # 5 Hz
    there = 1 + g * np.log(w0 * longest)  # K / K0 at the resonance, which f0 tells
    effect = effects.StructuralDamping(eta=g * np.pi / 2 / there, dispersion=1.0, exponent=1e-6, mean_below=np.log10(w0 * longest))
    still = line.filter(signal, rod.mechanics.response)
    found = np.fft.rfft(np.asarray(effect.displacement(still, signal, None, line, rod)))[:2] / np.fft.rfft(np.asarray(signal))[:2]
    for s, got in zip((0.0, 2j * np.pi * 5), found, strict=True):
        stiffness = w0**2 * (1 + g * np.log(1 + longest * s)) / there
        want = w0**2 / (s**2 + 2 * 0.2 * w0 * s + stiffness)
        assert got == pytest.approx(want, rel=2e-4)
    assert found[0].real > 1.08  # the mean has the static compliance


def test_backlash_in_detail_is_a_mean_of_plays_beside_an_elastic_path():
    y = 1e-5 * np.sin(2 * np.pi * np.arange(400) / 400)
    line = Timeline(jnp.asarray(1e-3), 400, True)

    def play(width):
        state, out = 0.0, []
        for value in np.tile(y, 3):
            state = min(max(state, value - width), value + width)
            out.append(state)
        return np.asarray(out[-400:])

    for spread, elastic in ((0.0, 0.0), (0.4, 0.15)):
        effect = effects.Backlash(gap=9e-7, spread=spread, elastic=elastic)
        plays = np.mean([play(9e-7 * (1 + spread * c)) for c in (-1, -0.5, 0, 0.5, 1)], axis=0)
        got = np.asarray(effect.displacement(jnp.asarray(y), None, None, line, None))
        assert np.abs(got - (y + (1 - elastic) * (plays - y))).max() < 1e-18


def test_excess_loss_in_detail_is_the_law_of_n0_and_v0():
    """Bertotti's law, which comes to the root at high rates; a share of it lies between."""
    k, knee = 30.0, 2.0
    n0_v0, slope = k * knee**0.5, 4 / knee  # A/m, s/T: k = (V0 sigma G S)^(1/2)
    rate = np.array([-300.0, -3.0, -1e-3, 0.0, 1e-2, 1.0, 40.0, 1e5])

    def shift(full):
        return np.asarray(effects.ExcessLoss(k=k, rate_knee=knee, full=full).field_shift(Rates(jnp.asarray(rate)), None, None))

    law = np.sign(rate) * n0_v0 / 2 * (np.sqrt(1 + slope * np.abs(rate)) - 1)
    assert np.abs(shift(1.0) - law).max() < 1e-5 * np.abs(law).max() and shift(1.0)[[2, 4, 5]] == pytest.approx(
        law[[2, 4, 5]], rel=1e-5
    )
    assert shift(1.0)[-1] == pytest.approx(k * 1e5**0.5, rel=0.01)
    assert shift(0.4) == pytest.approx(0.6 * shift(0.0) + 0.4 * law, rel=1e-5)


def test_a_second_mode_in_detail_is_any_two_coupled_masses():
    """A rod with a mass on a spring and a damper of its own, by the poles and residues of its equations of motion."""
    w1, xi, ratio, w_m, xi_m = 2 * np.pi * 400, 0.03, 0.15, 2 * np.pi * 650, 0.06
    mass, spring = np.diag([1, ratio]), np.array([[w1**2 + ratio * w_m**2, -ratio * w_m**2], [-ratio * w_m**2, ratio * w_m**2]])
    damp = np.array(
        [[2 * xi * w1 + 2 * ratio * xi_m * w_m, -2 * ratio * xi_m * w_m], [-2 * ratio * xi_m * w_m, 2 * ratio * xi_m * w_m]]
    )

    def motion(s):
        return np.linalg.solve(s * s * mass + s * damp + spring, [w1**2, 0])[0]

    inverse = np.linalg.inv(mass)
    poles = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ spring, -inverse @ damp]]))
    first, second = sorted((p for p in poles if p.imag > 0), key=abs)

    def numerator(pole):  # (a s + b) over (s - p)(s - p*), from the residue at p
        residue = motion(pole + 1e-4 * abs(pole)) * 1e-4 * abs(pole)
        residue = 2 * motion(pole + 5e-5 * abs(pole)) * 5e-5 * abs(pole) - residue
        return 2 * residue.real, -2 * (residue * pole.conjugate()).real

    (_, b1), (a2, b2) = numerator(first), numerator(second)
    w0, w2 = abs(first), abs(second)
    act = Mechanics(f0=w0 / 2 / np.pi, xi=-first.real / w0)
    gain = b2 / w2**2
    assert b1 / w0**2 + gain == pytest.approx(1, abs=1e-5)
    effect = effects.SecondMode(gain=gain, f2=w2 / 2 / np.pi, xi2=-second.real / w2, lead=a2 / w2 / gain)
    line = Timeline(jnp.asarray(1 / 40 / 200), 200, True)
    forcing = jnp.asarray(np.random.default_rng(0).normal(size=200))
    rod = jnp.asarray(line.filter(forcing, lambda s: w0**2 / (s * s + 2 * act.xi * w0 * s + w0**2)))
    found = np.asarray(effect.displacement(rod, forcing, None, line, dataclasses.replace(actuator(20), mechanics=act)))
    s = 2j * np.pi * 40 * np.arange(100)
    true = np.array([motion(one) for one in s])
    got = np.fft.rfft(found)[:100] / np.fft.rfft(np.asarray(forcing))[:100]
    assert np.abs(got - true).max() < 1e-4 * np.abs(true).max()
    assert abs(a2 / w2 / gain) > 0.01  # a matter of the damping, and not nothing here


def test_crosstalk_in_detail_comes_late():
    line, turn = Timeline(jnp.asarray(1 / 80 / 400), 400, True), 2 * np.pi * np.arange(400) / 400
    current = 0.3 * np.cos(turn) + 0.1 * np.sin(3 * turn)
    effect = effects.InductiveCrosstalk(kappa=2e-9, tau=4e-4)
    got = effect.reading(jnp.zeros(400), {"current": jnp.asarray(current)}, line, None)
    s = 2j * np.pi * 80 * np.arange(201)
    late = np.fft.irfft(np.fft.rfft(current) * 2e-9 * s / (1 + 4e-4 * s), 400)
    assert np.asarray(got) == pytest.approx(late, abs=1e-12 * np.abs(late).max())


def test_a_sensors_curve_is_legendres_about_its_range_and_straight_beyond():
    """It has no slope and no mean where the line was laid through: a gain is the magnetization's."""
    given = {"centre": 4e-5, "half": 1e-5}
    shapes = {"mix": 0.7, "c4": 0.5, "c5": -0.3, "c6": 0.2}
    series = np.polynomial.Legendre([0, 0, np.cos(0.7), np.sin(0.7), 0.5, -0.3, 0.2])
    curve, u = effects.SensorNonlinearity(q=0.02, **shapes, **given), np.linspace(-1.1, 1.1, 1001)

    def departure(effect, u):
        y = effect.centre + effect.half * u
        return np.asarray(effect.reading(y, None, None, actuator()) - y) / float(effect.half)

    assert departure(curve, u) == pytest.approx(0.02 * series(u), abs=1e-12)
    x, w = np.polynomial.legendre.leggauss(12)
    assert abs(w @ departure(curve, x)) < 1e-12 and abs((w * x) @ departure(curve, x)) < 1e-12
    for end in (-1.1, 1.1):
        beyond = end * np.array([1.0, 1.5, 4.0])
        assert departure(curve, beyond) == pytest.approx(0.02 * (series(end) + series.deriv()(end) * (beyond - end)), abs=1e-12)
    moved = dataclasses.replace(curve, c0=jnp.asarray(2.0))  # an offset before the curve, which stays where the readings are
    assert departure(moved, u - 0.04) == pytest.approx(departure(curve, u) + 0.04, abs=1e-12)
    travel = float(actuator().strained.reach)
    whole, stated = effects.SensorNonlinearity(q=0.02, **shapes), effects.SensorNonlinearity(q=0.02, **shapes, centre=travel / 2, half=travel / 2)
    y = travel * np.linspace(-0.2, 1.2, 50)
    assert np.array_equal(whole.reading(y, None, None, actuator()), stated.reading(y, None, None, actuator()))


def test_what_is_given_an_effect_by_the_recordings_is_not_fitted():
    effect = effects.SensorNonlinearity(**effects.SensorNonlinearity.seen_in((2e-5, 5e-5)))
    assert (float(effect.centre), float(effect.half)) == pytest.approx((3.5e-5, 1.5e-5))
    assert set(effect.parameters()) - set(effect.free_parameters()) == {"centre", "half"}


def test_details_of_a_law_are_held_until_they_are_asked_for():
    friction = effects.CoulombFriction(f=1e-6)
    assert friction.free_parameters() == ("f", "v_s", "presliding")
    finer = friction.in_detail()
    assert set(finer.free_parameters()) == set(friction.parameters()) and float(finer.stribeck) > 0 and float(finer.f) == 1e-6
    assert finer.in_detail() is None and effects.TransportDelay().in_detail() is None
    assert float(effects.DeltaE(e=0.1, static=0.4).in_detail().bend) > 0
    assert "exponent" not in effects.Creep().free_parameters() and float(effects.Creep().in_detail().exponent) != 0


def test_smooth_friction_approaches_coulomb():
    from magjax.effects import CoulombFriction

    act = actuator(20)
    with_friction = [
        np.asarray(reading(act.with_effect(CoulombFriction(f=2e-7, v_s=v, presliding=1e-9)))) for v in (1e-3, 1e-4, 1e-5)
    ]
    assert np.abs(with_friction[2] - with_friction[1]).mean() < 0.3 * np.abs(with_friction[1] - with_friction[0]).mean()


@pytest.mark.parametrize(
    "effect",
    [
        effects.SecondEddyPath(kappa=0.5, tau=3e-3, air=0.0),
        effects.SecondEddyPath(kappa=0.05, tau=1e-2, air=1.0),
        effects.SecondEddyPath(kappa=0.5, tau=3e-3, air=0.0, spread=1.0),
        effects.MagneticAftereffect(share=0.1, of_field=0.0),
        effects.MagneticAftereffect(share=0.1, of_field=1.0),
    ],
    ids=lambda e: e.name,
)
def test_slow_states_are_led_to_their_repeat(effect):
    act = actuator(20).with_effect(effect)
    few, many = (np.asarray(run_chain(act, CURRENT, DT, periods, 4).reading) for periods in (3, 7))
    before = np.asarray(run_chain(actuator(20), CURRENT, DT, 3, 4).reading)
    assert np.abs(few - many).max() < 0.03 * np.abs(many - before).max()


@pytest.mark.parametrize(
    ("of_field", "shortest", "exponent", "longest"),
    [(0.0, 1e-5, 0.0, 100.0), (0.0, 2e-3, 0.3, 3.0), (1.0, 3e-4, -0.3, 3.0), (0.0, 4e-4, -0.3, 8e-3)],
)
def test_the_aftereffect_weighs_its_lags_by_a_power_of_time_between_two_ends(of_field, shortest, exponent, longest):
    """What is late, against the ladder's response at each harmonic of the relays' magnetization or field."""
    act, dt, share = actuator(20), DT / 4, 0.1
    turn = jnp.arange(4 * N) / (4 * N)
    fine = CURRENT.mean() + 0.4 * jnp.ptp(CURRENT) * jnp.sin(2 * jnp.pi * turn)
    effect = effects.MagneticAftereffect(share=share, of_field=of_field, shortest=shortest, exponent=exponent, longest=longest)
    found = run_chain(act.with_effect(effect), fine, dt, 5, 4)
    times = 10.0 ** np.arange(-4, 0.1, 0.5)
    weights = times**exponent / (1 + (shortest / times) ** 2) / (1 + (times / longest) ** 2)
    s = 2j * np.pi * np.arange(len(fine) // 2 + 1)[:, None] / (len(fine) * dt)
    gain = 1 + share * ((weights / (1 + s * times)).sum(1) / weights.sum() - 1)
    H, M = np.asarray(found.field), np.asarray(found.magnetization)
    if of_field:  # H = v + S (v - late v): the field that the relays see lies behind
        late = np.fft.irfft(np.fft.rfft(H) / (2 - gain), len(fine))
        relays = np.asarray(act.hysteresis.magnetization(jnp.tile(late, 2), corners=6))[len(fine) :]
        error, effect_size = M - relays, np.asarray(act.hysteresis.magnetization(jnp.tile(H, 2), corners=6))[len(fine) :] - relays
    else:
        relays = np.asarray(act.hysteresis.magnetization(jnp.tile(found.field, 2), corners=6))[len(fine) :]
        error, effect_size = M - np.fft.irfft(gain * np.fft.rfft(relays), len(fine)), M - relays
    assert np.abs(error - error.mean()).max() < 0.02 * np.ptp(effect_size)


def test_a_second_path_round_the_coil_filters_the_drive():
    kappa, tau = 0.05, 2e-3
    line = Timeline(jnp.asarray(DT), N, True)
    act = actuator(20)
    inside = np.asarray(
        run_chain(act.with_effect(effects.SecondEddyPath(kappa=kappa, tau=tau, air=1.0)), CURRENT, DT, 4, 4, "bdf2").reading
    )
    filtered = CURRENT - line.filter(CURRENT, lambda s: kappa * tau * s / (1 + tau * s))
    outside = np.asarray(run_chain(act, filtered, DT, 4, 4, "bdf2").reading)
    without = np.asarray(run_chain(act, CURRENT, DT, 4, 4, "bdf2").reading)
    assert np.abs(inside - outside).max() < 0.03 * np.abs(outside - without).max()


def test_the_stress_of_a_moved_mass_is_that_of_its_acceleration():
    """A stress of rod and mass that follow slowly is that of the spring alone; through the resonance it turns round."""
    act = actuator(20).replace({"mechanics.f0": 1500.0, "mechanics.xi": 0.1})
    line = Timeline(jnp.asarray(DT), N, True)
    for inertia in (0.0, 4.0):
        found = run_chain(act.with_effect(effects.StressFeedback(stiffness=2e11, inertia=inertia)), CURRENT, DT, 3, 4)
        y = np.asarray(found.displacement)
        rate = np.asarray(line.derivative(found.displacement))
        acceleration = np.asarray(line.derivative(jnp.asarray(rate))) / (2 * np.pi * 1500.0) ** 2
        rod = act.magnetostriction
        shift = 2e11 * (y + inertia * acceleration) * 3 * float(rod.lambda_s) / (4e-7 * np.pi * float(rod.M_s) ** 2)
        shift = shift * np.asarray(found.magnetization)
        felt = np.asarray(found.field - found.relay_field)
        assert np.abs(felt).max() > 10 and np.abs(felt - shift).max() < 0.03 * np.ptp(shift)


@pytest.mark.parametrize("of_drive", [0.0, 0.4, 0.7, 1.0])
def test_thresholds_widen_by_the_relays_own_rate_or_by_that_of_the_applied_field(of_drive):
    """With an eddy loss the two rates differ: the shift is the law's, of the fields as they come out, at every step."""
    gamma, rate0 = 150.0, 2e5
    act = actuator().with_effect(effects.RateDependentSwitching(gamma=gamma, rate0=rate0, of_drive=of_drive))
    applied = act.coil.applied_field(CURRENT)
    memory = act.hysteresis.memory(act.hysteresis.table(), 8)
    H, _, _, v, residual, _ = magnetize(act, applied, CURRENT, DT, memory, "bdf2")
    own, driven = np.diff(v) / DT, np.abs(np.diff(applied)) / DT
    rate0 = rate0 + 1e-3
    law = gamma * ((1 - of_drive) * np.arcsinh(own / rate0) + of_drive * np.arcsinh(driven / rate0) * own / np.hypot(own, rate0))
    assert np.asarray(H - v)[1:] == pytest.approx(law, abs=1e-6 * gamma) and np.abs(law).max() > gamma
    assert np.abs(residual).max() < 1e-5


def test_half_of_a_second_path_has_its_own_time_in_detail():
    act, h, steps = actuator(20), 1e-5, 300
    effect = effects.SecondEddyPath(kappa=0.3, tau=2e-3, spread=1.0)
    trial = Trial(*(jnp.asarray(x) for x in (0.0, 0.0, 1.0, 0.0, 0.0)), h)  # dB/dt of 1 T/s from the first step on
    state = effect.start(trial, act)
    state = (*state[:2], act.coil.loss * jnp.asarray(1.0), *state[3:])
    for _ in range(steps):
        field = effect.field_shift(trial, state, act)
        state = effect.advance(trial, state, act)
    slow, early = (1 - np.exp(-steps * h / tau) for tau in (2e-3, 2e-4))
    assert float(field) == pytest.approx(0.3 * float(act.coil.loss) * (slow + early) / 2, rel=1e-3)
    plain = effects.SecondEddyPath(kappa=0.3, tau=2e-3)
    assert plain.in_detail() is not None and bool(jnp.all(jnp.asarray(plain.start(trial, act)[:2]) == 0.0))
