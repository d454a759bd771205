"""The rod in shells: its matrix, its step against a slow solver, its agreement with the plain step where all shells are alike."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import root
from scipy.special import jv

import magjax.effects as effects
from magjax.chain.march import magnetize
from magjax.chain.shells import distribution, march_shells
from magjax.constants import MU0
from magjax.linear import inverse_of_definite
from magjax.preisach.memory import apply_field
from magjax.simulate import run_chain, simulate
from tests.test_simulate import actuator, sine

N, DT = 100, 1 / (200 * 100)
CURRENT = jnp.asarray(np.append(sine(N, 0.7), sine(N, 0.7)[:40]))


def test_the_matrix_is_that_of_a_cylinder():
    """To as many digits as polynomials allow: of mean 1, the kernel's integral over a polynomial, and J1 / J0 of a rod of one permeability."""
    for count in (1, 3, 4):
        D, w = distribution(count)
        assert w @ D @ w == pytest.approx(1.0, abs=1e-13) and np.array_equal(D, D.T) and np.linalg.eigvalsh(D).min() > 0
    D, w = distribution(4)
    u = (np.polynomial.legendre.leggauss(4)[0] + 1) / 2
    for here, row in zip(u, D, strict=True):
        whole = quad(lambda x, here=here: -2 * np.log(max(x, here)) * (1 - 3 * x + x**3), 0, 1, points=[here])[0]
        assert row @ (w * (1 - 3 * u + u**3)) == pytest.approx(whole, abs=1e-9)
    for rate, miss in ((0.3, 1e-10), (1.0, 1e-7), (10.0, 1e-3)):  # of the mean's lag in an angular period
        x = np.sqrt(-8j * rate)
        whole = 2 * jv(1, x) / (x * jv(0, x))
        found = w @ np.linalg.solve(np.eye(4) + 1j * rate * D * w, np.ones(4))
        assert abs(found - whole) < miss * abs(1 - whole)


@pytest.mark.long
def test_four_depths_are_nearly_those_of_ten(monkeypatch):
    """Of a rod wholly of depths, where the skin leads most: four shells of equal area were 100 nm off."""
    act = actuator(20).replace({"coil.R_eddy": 18.5}).with_effect(effects.FieldDiffusion(kappa=1.0))
    readings = []
    for count in (4, 10):
        monkeypatch.setattr(effects.FieldDiffusion, "shells", count)
        jax.clear_caches()
        readings.append(np.asarray(run_chain(act, CURRENT[:N], DT, 2, 4, "bdf2").reading))
    monkeypatch.undo()
    jax.clear_caches()
    assert np.std(readings[1] - readings[0]) < 1e-3 * np.ptp(readings[1])


def test_inverses_of_a_batch_need_no_pivots():
    rng = np.random.default_rng(0)
    B = rng.normal(size=(50, 4, 4))
    matrices = (B @ B.swapaxes(1, 2) + 1e-3 * np.eye(4)) * 10 ** rng.uniform(-2, 3, (50, 1, 4))  # columns scaled
    found = jax.vmap(inverse_of_definite)(jnp.asarray(matrices))
    assert np.abs(matrices @ found - np.eye(4)).max() < 1e-10
    assert inverse_of_definite(jnp.array([[4.0]])) == 0.25


BESIDE = {
    "alone": (),
    "excess_loss": (effects.ExcessLoss(k=20.0),),
    "mean_field+magnetic_aftereffect": (effects.MeanField(alpha=0.01), effects.MagneticAftereffect(share=0.1)),
    "second_eddy_path+rate_dependent_switching": (
        effects.SecondEddyPath(kappa=0.1, tau=1e-3, air=0.5), effects.RateDependentSwitching(gamma=20.0),
    ),
}  # fmt: skip
SAMPLE = {("excess_loss", "bdf2"), ("mean_field+magnetic_aftereffect", "trapezoid")}


@pytest.mark.parametrize(
    ("scheme", "extra"),
    [
        pytest.param(scheme, extra, id=f"{name}-{scheme}", marks=[] if (name, scheme) in SAMPLE else pytest.mark.long)
        for name, extra in BESIDE.items()
        for scheme in ("bdf2", "trapezoid")
    ],
)
def test_shells_that_share_one_field_march_as_the_rod_does(scheme, extra):
    act = actuator(20)
    for effect in extra:
        act = act.with_effect(effect)
    applied, memory = act.coil.applied_field(CURRENT), act.hysteresis.memory(act.hysteresis.table(), 4)
    given = tuple(s * jnp.sin(jnp.linspace(0, 9, len(CURRENT))) for s in (30.0, 200.0, 50.0))
    plain = magnetize(act, applied, CURRENT, DT, memory, scheme, given, period=N)
    cut = march_shells(act, 0.0, 3, applied, CURRENT, DT, memory, scheme, given, period=N)
    for a, b, name in zip((*plain[:2], plain[3]), (*cut[:2], cut[3]), ("H", "M", "v"), strict=True):
        assert np.abs(np.asarray(a - b)).max() < 1e-7 * np.ptp(np.asarray(a)), name
    assert np.abs(np.asarray(cut[4])).max() < 1e-5


@pytest.mark.parametrize("scheme", ["bdf2", "trapezoid"])
def test_every_step_against_a_general_solver(scheme):
    act, share, count = actuator(20), 0.8, 3
    applied = np.asarray(act.coil.applied_field(CURRENT))[:60]
    table = act.hysteresis.table()
    start = act.hysteresis.memory(table, 4)
    H, M, spread, _, residual, over = march_shells(act, share, count, jnp.asarray(applied), CURRENT[:60], DT, start, scheme)
    assert np.abs(np.asarray(residual)).max() < 1e-6 and not over
    at = jax.jit(jax.vmap(lambda memory, v: apply_field(table, memory, v)))
    D, w = distribution(count)
    D = (1 + share * (D - 1)) * w * MU0 * float(act.coil.loss) / DT
    memory = at(jax.vmap(lambda _: start)(jnp.arange(count)), jnp.full(count, applied[0]))
    X = before = np.asarray(memory.field + memory.magnetization)
    old = np.asarray(memory.field)
    for n in range(1, 60):

        def misfit(v, n=n, X=X, before=before, old=old, memory=memory):
            new = v + np.asarray(at(memory, jnp.asarray(v)).magnetization)
            if scheme == "bdf2":
                return v + D @ (1.5 * new - 2 * X + 0.5 * before) - applied[n]
            return 0.5 * (v + old) + D @ (new - X) - 0.5 * (applied[n] + applied[n - 1])

        found = root(misfit, old, method="hybr", options={"xtol": 1e-12}).x
        memory = at(memory, jnp.asarray(found))
        X, before, old = found + np.asarray(memory.magnetization), X, found
        assert float(H[n]) == pytest.approx(w @ found, abs=1e-5 * np.ptp(applied))
        assert float(M[n]) == pytest.approx(w @ np.asarray(memory.magnetization), abs=1e-5 * np.ptp(np.asarray(M)))
        square = w @ np.asarray(memory.magnetization) ** 2
        assert float(M[n] ** 2 + spread[n]) == pytest.approx(square, abs=1e-5 * float(np.max(spread)))


def test_a_rod_whose_skin_leads_strains_by_the_mean_square():
    """Sections stay plane: the square of the mean M alone would miss what skin and core differ by."""
    act = actuator(20).with_effect(effects.FieldDiffusion(kappa=0.8))
    applied, memory = act.coil.applied_field(CURRENT[:N]), act.hysteresis.memory(act.hysteresis.table(), 4)
    _, M, spread, *_ = (np.asarray(x) for x in magnetize(act, applied, CURRENT[:N], DT, memory, "bdf2"))
    free = np.asarray(run_chain(act, CURRENT[:N], DT, 0, 4, "bdf2").free_displacement)
    rod = act.magnetostriction
    assert free == pytest.approx(float(rod.reach) * (M**2 + spread) / float(rod.M_s) ** 2, rel=1e-12)
    assert float(rod.reach) * np.max(spread) / float(rod.M_s) ** 2 > 1e-3 * np.ptp(free)
    one = act.replace({"effects.field_diffusion.alike": 1.0})
    free = np.asarray(run_chain(one, CURRENT[:N], DT, 0, 4, "bdf2").free_displacement)
    assert free == pytest.approx(float(rod.reach) * M**2 / float(rod.M_s) ** 2, rel=1e-9)


def test_derivatives_of_the_constants_through_the_shells():
    act = actuator(20).with_effect(effects.FieldDiffusion(kappa=0.7, alike=0.4)).with_effect(effects.MeanField(alpha=0.003))
    steps = {"coil.R_eddy": 1e-3, "effects.field_diffusion.kappa": 1e-5, "effects.field_diffusion.alike": 1e-4, "effects.mean_field.alpha": 1e-7, "coil.H_bias": 0.1}
    values = np.asarray([float(act.parameters()[name][0]) for name in steps])

    @jax.jit
    def reading_and_slope(x, d):
        changed = lambda x: act.replace(dict(zip(steps, x, strict=True)))
        return jax.jvp(lambda x: run_chain(changed(x), CURRENT[:N], DT, 2, 4, "bdf2").reading, (x,), (d,))

    for (name, step), unit in zip(steps.items(), np.eye(len(steps)), strict=True):
        exact = np.asarray(reading_and_slope(values, unit)[1])
        above, below = (np.asarray(reading_and_slope(values + s * step * unit, unit)[0]) for s in (1, -1))
        number = (above - below) / (2 * step)
        assert np.abs(exact - number).max() < 1e-4 * np.abs(number).max(), name


def test_the_skin_leads_and_slow_drives_do_not_see_it():
    act = actuator(20)
    solid = act.with_effect(effects.FieldDiffusion(kappa=1.0))
    changes = []
    for f in (2.0, 20.0, 200.0):
        plain, cut = (np.asarray(simulate(a, CURRENT[:N], 1 / (f * N), periodic=True).magnetization) for a in (act, solid))
        changes.append(np.abs(cut - plain).max() / np.ptp(plain))
    assert changes[0] < 1e-3 and changes[0] < 0.1 * changes[1] < 0.1 * changes[2]


def test_a_share_beyond_its_range_still_has_steps():
    for kappa in (-3.0, 1.0, 50.0):
        signals = run_chain(actuator(20).with_effect(effects.FieldDiffusion(kappa=kappa)), CURRENT[:N], DT, 2, 4)
        assert np.abs(np.asarray(signals.residual)).max() < 1e-5 and np.isfinite(np.asarray(signals.reading)).all()


def test_a_share_below_none_is_none():
    """Field that would diffuse backwards grows without end: at -3e-5 and 500 samples a period loops were off by their height. A fit of
    a rod without diffusion, which stepped there, ended at 2e6 times its noise."""
    from fitting.setup import _bounds
    from magjax.bench import load_bench

    drive = jnp.asarray(0.1 + 0.7 * np.sin(2 * np.pi * np.arange(500) / 500))
    rod = actuator(20)
    read = jax.jit(lambda kappa: run_chain(rod.with_effect(effects.FieldDiffusion(kappa=kappa)), drive, 1 / (300 * 500), 14, 4).reading)
    plain = np.asarray(read(0.0))
    assert max(np.abs(np.asarray(read(k)) - plain).max() for k in (-1e-4, -1e-2)) < 1e-6 * np.ptp(plain)
    bench, names = load_bench("aa-050h"), ("effects.field_diffusion.kappa", "effects.excess_loss.k")
    known = bench.actuator().with_effect(effects.FieldDiffusion()).with_effect(effects.ExcessLoss()).parameters()
    lows, highs = _bounds(names, [0.0, 0.0], [known[n][1] for n in names], [False, False], bench)
    assert lows.tolist() == [0.0, -np.inf] and highs[0] == 1.0  # others come out as nothing of either sign


@pytest.mark.long
@pytest.mark.parametrize(("alike", "shapes"), [(0.0, {}), (1.0, {"alike": 1.0})])
def test_the_screening_scores_it_at_its_finite_size_in_the_form_that_serves(alike, shapes):
    from fitting.demo import concealed_actuator, record
    from fitting.fit import fit
    from fitting.screen import screen
    from fitting.setup import Choices
    from magjax.bench import load_bench

    truth = concealed_actuator(load_bench("aa-050h")).with_effect(effects.FieldDiffusion(kappa=0.6, alike=alike))
    rng = np.random.default_rng(0)
    runs = [record(truth, f, a, 0.05, rng, f"{f}") for f, a in ((10, 0.8), (40, 0.4), (100, 0.8), (200, 0.4), (300, 0.8))]
    found = fit(runs, load_bench("aa-050h"), choices=Choices(fine=250, knots=(12, 9), level=48, rest="negative"), refine=False)
    scores = {c.name: c for c in screen(found.problem, found.refined)}
    best = scores["field_diffusion"]
    assert best.tried_at == best.amplitude == best.smallest_visible and scores["creep"].tried_at is None
    assert best.z > 5 and best.amplitude == 0.5 and best.shapes == shapes


def test_every_step_of_a_rough_density_settles():
    """Where slopes of M differ by decades from cell to cell, some steps take more than a hundred of Newton's."""
    rng = np.random.default_rng(1)
    act = actuator(100).replace({"coil.R_eddy": 40.0}).with_effect(effects.FieldDiffusion(kappa=1.0))
    masses = np.asarray(act.hysteresis.masses)
    rough = masses * np.exp(2.0 * rng.normal(size=masses.shape))
    act = eqx.tree_at(lambda a: a.hysteresis.masses, act, jnp.asarray(rough * masses.sum() / rough.sum()))
    time = np.arange(1000) / 500
    march = jax.jit(lambda drive: run_chain(act, drive, 1 / (300 * 500), 0, 4, "bdf2").residual)
    for amplitude, offset in ((0.93, -0.05), (0.84, -0.26), (0.81, 0.03), (0.71, -0.04), (0.84, -0.18)):
        assert np.abs(np.asarray(march(jnp.asarray(amplitude * np.sin(2 * np.pi * time) + offset)))).max() < 1e-5
