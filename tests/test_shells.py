"""The rod in shells: its matrix, its step against a slow solver, its agreement with the plain step where all shells are alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.optimize import root

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
    for count in (1, 3, 4):
        D = distribution(count)
        assert D.mean() == pytest.approx(1.0, abs=1e-14) and np.array_equal(D, D.T) and np.linalg.eigvalsh(D).min() > 0
    D = distribution(3)
    for i, j in ((0, 0), (0, 2), (1, 1), (2, 1)):
        box = (i / 3, (i + 1) / 3, j / 3, (j + 1) / 3)
        whole = dblquad(lambda y, x: -2 * np.log(max(x, y, 1e-300)), *box, epsabs=1e-5)[0]
        assert D[i, j] == pytest.approx(9 * whole, abs=2e-3)


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
    D = (1 + share * (distribution(count) - 1)) * MU0 * float(act.coil.loss) / DT / count
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
        assert float(H[n]) == pytest.approx(found.mean(), abs=1e-5 * np.ptp(applied))
        assert float(M[n]) == pytest.approx(np.asarray(memory.magnetization).mean(), abs=1e-5 * np.ptp(np.asarray(M)))
        square = np.mean(np.asarray(memory.magnetization) ** 2)
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
