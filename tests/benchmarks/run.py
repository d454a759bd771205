"""`python -m tests.benchmarks.run [NAME ...]`: every ratio of the README's table, in one run, kept in results.json."""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from magjax.bench import load_bench  # noqa: E402
from magjax.preisach import density_masses  # noqa: E402
from magjax.preisach.operator import Preisach  # noqa: E402
from magjax.simulate import run_chain, sweep  # noqa: E402

from . import baselines  # noqa: E402


def best(function, repeats=5, least=0.2):
    """Smallest time of one call, s, after a warm-up."""
    jax.block_until_ready(function())
    times = []
    begin = time.perf_counter()
    while len(times) < repeats or time.perf_counter() - begin < least:
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
        if time.perf_counter() - begin > 20:
            break
    return min(times)


def actuator_at(level: int = 25):
    """T&B's bench on a plane of another level."""
    actuator = load_bench("aa-050h").actuator()
    masses = density_masses(lambda s, r: np.exp(-(((s - 1.1e4) / 6e3) ** 2)) / (1 + (r / 1500) ** 2), level, -2e3, 2.7e4, 3.9e5)
    import dataclasses

    return dataclasses.replace(actuator, hysteresis=Preisach(masses, -2e3, 2.7e4, 3.9e5))


def drive(count=2000, frequency=100.0, samples=500):
    """Current over periods of a sine and the step, s."""
    return 0.1 + 0.7 * np.sin(2 * np.pi * np.arange(count) / samples), 1 / (frequency * samples)


def single():
    """One trajectory against the compiled loop, diffrax, solve_ivp and the relay grid."""
    actuator = actuator_at()
    current, dt = drive()
    applied = np.asarray(actuator.coil.applied_field(jnp.asarray(current)))
    run = jax.jit(lambda c: run_chain(actuator, c, dt, 0, 4).magnetization)
    ours = best(lambda: run(jnp.asarray(current)))
    few = 60
    loop = best(lambda: baselines.compiled_loop(actuator, applied, dt))
    diffrax = best(baselines.diffrax_solver(actuator, applied[:500], dt), 2) * len(applied) / 500
    ivp = best(lambda: baselines.solve_ivp_numpy(actuator, applied[:few], dt), 1, 0) * len(applied) / few
    grid = best(lambda: baselines.numpy_relay_grid(actuator, applied[:few], dt), 1, 0) * len(applied) / few
    return {
        "time over compiled loop (bar <= 3)": ours / loop, "diffrax over ours (bar >= 10)": diffrax / ours,
        "solve_ivp over ours (bar >= 500)": ivp / ours, "relay grid over ours": grid / ours, "us per step": ours / len(current) * 1e6,
    }  # fmt: skip


def batch():
    """Batches against the compiled serial loop, and how the cost grows with the level."""
    current, dt = drive(1000)
    found = {}
    actuator = actuator_at()
    applied = np.asarray(actuator.coil.applied_field(jnp.asarray(current)))
    loop = best(lambda: baselines.compiled_loop(actuator, applied, dt))
    scale = jnp.linspace(0.5, 1.0, 1000)[:, None]
    for number in (64, 1000):
        run = jax.jit(jax.vmap(lambda c: run_chain(actuator, c, dt, 0, 4).magnetization))
        currents = scale[:number] * jnp.asarray(current)
        found[f"batch of {number}, per trajectory over compiled loop (bar <= 0.35)"] = (
            best(lambda r=run, c=currents: r(c), 3) / number / loop
        )
    times = []
    for level in (25, 50, 100, 200):
        big = actuator_at(level)
        run = jax.jit(jax.vmap(lambda c, b=big: run_chain(b, c, dt, 0, 4).magnetization))
        times.append(best(lambda r=run: r(scale[:64] * jnp.asarray(current)), 3))
    found["exponent of the cost in L, 25..200 (bar <= 0.1)"] = float(np.polyfit(np.log([25, 50, 100, 200]), np.log(times), 1)[0])
    return found


def derivatives():
    """jvp, a Jacobian column and reverse mode, in forwards."""
    actuator = actuator_at()
    current, dt = drive(1000)
    masses = actuator.hysteresis.masses

    def reading(m):
        return run_chain(actuator.replace({"hysteresis.masses": m}), jnp.asarray(current), dt, 0, 4).reading

    forward = best(lambda f=jax.jit(reading): f(masses))
    one = jnp.ones_like(masses)
    jvp = best(lambda f=jax.jit(lambda m: jax.jvp(reading, (m,), (one,))[1]): f(masses))
    directions = jnp.eye(masses.size)[:200].reshape(200, *masses.shape)

    def columns(m):
        _, push = jax.linearize(reading, m)
        return jax.lax.map(push, directions, batch_size=40)

    column = best(lambda f=jax.jit(columns): f(masses), 2) / 200
    reverse = best(lambda f=jax.jit(jax.grad(lambda m: jnp.sum(reading(m) ** 2))): f(masses))
    return {
        "jvp, forwards (bar <= 1.7)": jvp / forward,
        "Jacobian column, forwards (bar <= 0.5)": column / forward,
        "reverse, forwards (bar <= 3)": reverse / forward,
    }


def static():
    """Value and gradient in all masses where the field is known: ms, against a forward of the streaming operator."""
    from magjax.preisach.static import static_path, static_value_and_gradient

    T = 10_000
    field = 1.2e4 + 1.1e4 * np.sin(np.arange(T) * 0.02) * np.linspace(1, 0.3, T) + 800 * np.sin(np.arange(T) * 0.13)
    path = static_path(field, -2e3)
    found = {}
    for level in (25, 50, 100, 200):
        h = actuator_at(level).hysteresis
        run = static_value_and_gradient(lambda M: jnp.sum(M**2), h.low, h.high, h.offset, path)
        stream = jax.jit(
            lambda m, h=h: Preisach.magnetization(jax.tree_util.tree_map(lambda x: x, h), jnp.asarray(field), corners=48)
        )
        ours = best(lambda r=run, h=h: r(h.masses))
        found[f"L = {level}: value and gradient, ms (bar <= 1)"] = 1e3 * ours
        found[f"L = {level}: streaming forward over ours"] = best(lambda s=stream, h=h: s(h.masses), 2) / ours
    return found


def memory():
    """Memory of value and gradient where the field is known, MB: of the program at T = 10,000; at T = 1e6 what the process grew."""
    from magjax.preisach.static import static_path, static_value_and_gradient

    found, grown = {}, {}
    h = actuator_at(100).hysteresis
    for T in (1000, 1_000_000):
        field = 1.2e4 + 1.1e4 * np.sin(np.arange(T) * 0.02)
        run = static_value_and_gradient(lambda M: jnp.sum(M**2), h.low, h.high, h.offset, static_path(field, -2e3))
        jax.block_until_ready(run(h.masses))
        grown[T] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found["T = 1e6: peak memory grown by, MB (bar < 500)"] = grown[1_000_000] - grown[1000]

    @jax.jit
    def whole(masses, h, path):
        return static_value_and_gradient(lambda M: jnp.sum(M**2), h.low, h.high, h.offset, path)(masses)

    field = 1.2e4 + 1.1e4 * np.sin(np.arange(10_000) * 0.02) * np.linspace(1, 0.3, 10_000)
    for level in (25, 200):
        h = actuator_at(level).hysteresis
        used = whole.lower(h.masses, h, static_path(field, -2e3)).compile().memory_analysis()
        bytes_ = used.temp_size_in_bytes + used.argument_size_in_bytes + used.output_size_in_bytes
        found[f"T = 10,000, L = {level}: memory, MB (bar <= 20)"] = bytes_ / 2**20
    return found


ONE_FIT = """
import json, time
from magjax.cli.runtime import prepare_jax
prepare_jax()
from fitting.fit import fit
from magjax.bench import load_bench
from tests.studies.joint_fit import SINES, one_draw, settled
recordings, start = one_draw(settled("gauss"), 0)
bench = load_bench("aa-050h")
begin = time.perf_counter()
found = fit(recordings[: len(SINES)], bench, actuator=bench.actuator().replace(start))
print(json.dumps({"whole": time.perf_counter() - begin, "compile": found.compile_s, "solve": found.solve_s, "chi2n": found.chi2_per_sample}))
"""


def joint_fit():
    """Nine recordings of a bench of the independent generator, each time by a fresh process: nothing kept, then what the first kept."""
    with tempfile.TemporaryDirectory() as cache:
        command, env = [sys.executable, "-c", ONE_FIT], {**os.environ, "MAGJAX_CACHE": cache}
        cold, cached = (
            json.loads(subprocess.run(command, env=env, check=True, capture_output=True, text=True).stdout) for _ in range(2)
        )
    return {
        "cold: compilation, s (bar <= 5)": cold["compile"], "cached: compilation, s (bar <= 2)": cached["compile"],
        "solve, s (bar <= 3)": cached["solve"], "chi2/N (bar < 1.1)": cached["chi2n"],
        "cold: whole fit, s": cold["whole"], "cached: whole fit, s": cached["whole"],
    }  # fmt: skip


COMPILED = """
import json, sys, time
from magjax import programs
from magjax.cli.runtime import prepare_jax
prepare_jax()
if sys.argv[1] == "usual":
    programs.COMPILER.clear()
import magjax.effects as effects
from fitting.joint import data_jacobian, data_residual
from fitting.setup import Choices, build_problem, effect_parameters, free_parameters, spectra_of
from magjax.bench import load_bench
from tests.studies.joint_fit import SINES, one_draw, settled
recordings, _ = one_draw(settled("gauss"), 0)
bench, found = load_bench("aa-050h"), []
spectra = spectra_of(recordings[: len(SINES)], bench)
for held in ((), (effects.StressFeedback(),), (effects.CoulombFriction(f=3e-8), effects.ExcessLoss(k=10.0))):
    actuator = bench.actuator()
    for effect in held:
        actuator = actuator.with_effect(effect)
    problem, z = build_problem(spectra, actuator, bench, free_parameters(bench, actuator, effect_parameters(actuator)), Choices(rest="negative"))
    times = []
    for _ in range(4):
        begin = time.process_time()
        data_residual(problem, z), data_jacobian(problem, z)
        times.append(time.process_time() - begin)
    found.append((times[0] - min(times), min(times)))
print(json.dumps(found))
"""


def jacobian():
    """The Jacobian of nine loops by the lines of the reading, over the same by unknowns pushed through the chain a hundred at a time."""
    from fitting.joint import data_jacobian
    from fitting.model import whitened
    from fitting.setup import Choices, build_problem, free_parameters, spectra_of
    from tests.studies.joint_fit import SINES, one_draw, settled

    bench, found = load_bench("aa-050h"), {}
    actuator, spectra = bench.actuator(), spectra_of(one_draw(settled("gauss"), 0)[0][: len(SINES)], bench)
    for knots in ((18, 13), (48, 32)):
        problem, z = build_problem(spectra, actuator, bench, free_parameters(bench, actuator), Choices(knots=knots, rest="negative"))
        layout, coarse, width = problem.layout, problem.predictors[0], 100

        def residual(y, layout=layout, coarse=coarse, problem=problem):
            return whitened(coarse(layout.actuator(problem.template, y), layout.levels(y)), problem.target)

        def pushed(z, directions, residual=residual):
            return jax.lax.map(jax.vmap(jax.linearize(residual, z)[1]), directions)

        count = -(-len(z) // width) * width
        directions, run = jnp.eye(count, len(z)).reshape(-1, width, len(z)), jax.jit(pushed)
        whole = np.asarray(run(jnp.asarray(z), directions)).reshape(count, -1)[: len(z)].T
        rows = data_jacobian(problem, z)
        assert np.abs(rows - whole).max() < 1e-9 * np.abs(whole).max()
        columns = best(lambda run=run, z=z, directions=directions: run(jnp.asarray(z), directions), 3)
        ours = best(lambda problem=problem, z=z: data_jacobian(problem, z), 3)
        found[f"{len(z)} unknowns, over pushed columns (bar < 1)"] = ours / columns
        found[f"{len(z)} unknowns, ms"] = 1e3 * ours
    return found


def grids():
    """A fit of nine loops whose trial steps go by the Jacobian's grid, over the same all on the fine one; alone, and of many periods
    beside a field that diffuses."""
    import magjax.effects as effects
    from fitting.joint import solve
    from fitting.setup import Choices, build_problem, effect_parameters, free_parameters, spectra_of
    from tests.studies.joint_fit import SINES, one_draw, settled

    bench, found = load_bench("aa-050h"), {}
    spectra = spectra_of(one_draw(settled("gauss"), 0)[0][: len(SINES)], bench)
    for name, held, periods in (("alone", (), 3), ("14 periods, diffusion", (effects.FieldDiffusion(kappa=0.5),), 14)):
        actuator = bench.actuator()
        for effect in held:
            actuator = actuator.with_effect(effect)
        names = free_parameters(bench, actuator, effect_parameters(actuator))
        problem, z = build_problem(spectra, actuator, bench, names, Choices(rest="negative", periods=periods))
        own, both, seconds, weights = problem.passes.stride, {}, {}, np.asarray(problem.target.weights)

        def run(problem=problem, z=z, weights=weights, both=both):
            both[problem.passes.stride] = found = solve(problem, z, weights)
            return found.z

        for stride in (own, 1):
            problem.passes.stride = stride
            seconds[stride] = best(run, 3)
        assert own > 1 and abs(both[own].chi2 / both[1].chi2 - 1) < 1e-2
        found[f"{name}, over all on the fine grid (bar < 1)"] = seconds[own] / seconds[1]
        found[f"{name}, s"] = seconds[own]
    return found


def compiler():
    """A residual and its Jacobian traced and compiled as `magjax.programs.COMPILER` asks, over the same as the compiler does by itself."""
    rows = {}
    for way in ("ours", "usual"):
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, "-c", COMPILED, way]
            done = subprocess.run(command, env={**os.environ, "MAGJAX_CACHE": cache}, check=True, capture_output=True, text=True)
            rows[way] = json.loads(done.stdout)
    found = {}
    for name, ours, usual in zip(("plain", "stress_feedback", "friction and excess_loss"), rows["ours"], rows["usual"], strict=True):
        found[f"{name}: processor time until it runs, over the usual"] = ours[0] / usual[0]
        found[f"{name}: that of a run, over the usual"] = ours[1] / usual[1]
    return found


def grid():
    """200 x 20 sweep to steady state against the same with the compiled serial loop; memory above jax's and xarray's imports."""
    import xarray  # noqa: F401  (56 MB that the result's library takes, whatever is swept)

    actuator = actuator_at()
    frequencies, amplitudes = np.linspace(5, 400, 200), np.linspace(0.05, 0.8, 20)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sweep(actuator, frequencies[:26], amplitudes, 0.1)  # fills a chunk: compiles what the whole takes
    compiled = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    sweep(actuator, frequencies, amplitudes, 0.1)
    ours = time.perf_counter() - start
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    current = 0.1 + 0.5 * np.sin(2 * np.pi * np.arange(4 * 200) / 200)
    applied = np.asarray(actuator.coil.applied_field(jnp.asarray(current)))
    loop = best(lambda: baselines.compiled_loop(actuator, applied, 1 / (100 * 200)))
    return {
        "4000 trajectories, s (bar <= 0.5)": ours,
        "compiled serial loop over ours": 4000 * loop / ours,
        "peak memory grown by, MB (bar <= 150)": (grown - compiled) / 1024,
        "peak memory grown by, with its compilation, MB": (grown - before) / 1024,
    }


def inversion():
    """Algorithm (6) against a bisection of the same accuracy, both pure Python on the same operator."""
    operator = baselines.plain(actuator_at())
    targets = operator.offset + 0.9 * operator.total * np.sin(np.arange(3000) * 0.02)
    ours = best(lambda: operator.copy().invert(targets), 2)

    def bisection():
        state = operator.copy()
        for m in targets[:100]:
            low, high = state.low, state.high
            for _ in range(52):
                middle = 0.5 * (low + high)
                if state.copy().apply(middle) < m:
                    low = middle
                else:
                    high = middle
            state.apply(0.5 * (low + high))
        return state

    slow = best(bisection, 1, 0) * len(targets) / 100
    many = operator.offset + 0.9 * operator.total * np.sin(np.arange(1_000_000) * 0.01)
    fast = best(lambda: operator.copy().invert(many, accelerate=True), 2)
    return {
        "bisection over pure inversion (bar >= 15)": slow / ours,
        "pure, us a smooth sample (bar <= 10)": ours / len(targets) * 1e6,
        "compiled, us a smooth sample (bar <= 0.5)": fast,
    }


def l1():
    """A design at 40 taps, s."""
    from magjax.control import design

    return {"l1 design at 40 taps, s (bar < 0.3)": best(design, 3)}


GROUPS = {
    "single": single,
    "batch": batch,
    "derivatives": derivatives,
    "static": static,
    "memory": memory,
    "sweep": grid,
    "inversion": inversion,
    "l1": l1,
    "fit": joint_fit,
    "jacobian": jacobian,
    "compiler": compiler,
    "grids": grids,
}


def main():
    """Run the groups named, or all; print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"{', '.join(GROUPS)} (default all)")
    names = parser.parse_args().groups or list(GROUPS)
    if unknown := [name for name in names if name not in GROUPS]:
        parser.error(f"no group {', '.join(unknown)}; there are {', '.join(GROUPS)}")
    if len(names) > 1:  # each in a process of its own: the peak memory of one would hide what another needs
        for name in names:
            subprocess.run([sys.executable, "-m", "tests.benchmarks.run", name], check=True)
        return
    found = {}
    for name in names:
        found[name] = {k: float(v) for k, v in GROUPS[name]().items()}
        for k, v in found[name].items():
            print(f"{name:12s} {k:70s} {v:10.3g}", flush=True)
    path = Path(__file__).with_name("results.json")
    kept = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps({**kept, **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
