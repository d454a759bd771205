"""Programs kept between processes: read where nothing has changed, traced where anything has."""

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import magjax.programs as programs
from magjax.bench import load_bench
from magjax.chain import Timeline
from magjax.programs import forget, kept, often
from magjax.simulate import Signals, run_chain

pytest.importorskip("flatbuffers")
try:
    from jax import export  # noqa: F401
except ImportError as error:
    pytest.skip(f"this jax keeps no programs: {error}", allow_module_level=True)

TRACED = []


@pytest.fixture(autouse=True)
def folder(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    TRACED.clear()
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)
    forget()


@kept
def scaled(line, values, factor, more=None):
    TRACED.append(factor)
    return [values * factor * line.dt, (line.time, None)], {"more": line.dt if more is None else more}


@often
def scaled_often(line, values):
    return values * line.dt


def test_a_program_is_read_and_not_traced_again(folder):
    line, values = Timeline(jnp.asarray(0.5), 6, True), jnp.arange(6.0)
    first = scaled(line, values, 2.0)
    assert TRACED == [2.0] and len(list(folder.iterdir())) == 1
    for _ in range(2):
        forget()  # as another process
        again = scaled(line, np.arange(6.0) + 1, 2.0)
    assert TRACED == [2.0] and np.allclose(again[0][0], np.arange(6) + 1.0)
    assert jax.tree.structure(first) == jax.tree.structure(again) and again[0][1][1] is None and float(again[1]["more"]) == 0.5
    # what a trace depends on makes another: a constant, a shape, what a module holds fast, its structure
    scaled(line, values, 3.0), scaled(line, jnp.ones((2, 6)), 2.0), scaled(Timeline(jnp.asarray(0.5), 7, True), values, 2.0)
    scaled(Timeline(jnp.asarray(0.5), 6, False), values, 2.0), scaled(line, values, 2.0, values)
    assert len(TRACED) == 6 == len(list(folder.iterdir()))


BY_LAPACK = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_compilation_cache_dir", {folder!r})
jax.config.update("jax_enable_x64", True)
from fitting.model import on_device
from magjax import linear, programs
print(np.asarray(programs.kept(linear.inverse_of)(on_device(2.0 * np.eye(3))))[0, 0], len(programs.IN_MEMORY[-1][0]))
"""


def test_a_program_that_was_read_finds_lapack(folder):
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", BY_LAPACK.format(folder=str(folder.parent))], capture_output=True, text=True)
        assert (done.returncode, done.stdout.split()) == (0, ["0.5", "1"]), done.stderr
        assert len(list(folder.glob("*.program"))) == 1


def test_it_gives_what_the_traced_one_gives(folder):
    act, drive = load_bench("aa-050h").actuator(), jnp.asarray(0.5 * np.sin(2 * np.pi * np.arange(60) / 60))
    run, plain = kept(run_chain), eqx.filter_jit(run_chain)
    run(act, drive, 1e-4, 2, 4)
    assert len(list(folder.iterdir())) == 1  # though its results stand in a module
    forget()
    found, expected = run(act, drive, 1e-4, 2, 4), plain(act, drive, 1e-4, 2, 4)
    assert isinstance(found, Signals) and jax.tree.structure(found) == jax.tree.structure(expected)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True))
    slope = jax.jvp(lambda x: run(act, x, 1e-4, 2, 4).reading, (drive,), (drive,))[
        1
    ]  # inside another trace it is a function as any
    assert np.isfinite(np.asarray(slope)).all()


def test_it_is_compiled_once(folder):
    """Whatever the arguments come from, and where two threads ask for it at the same time."""
    compiled, line = [], Timeline(jnp.asarray(0.5), 6, True)
    values = [jnp.arange(6.0), np.arange(6.0), scaled(line, jnp.arange(6.0), 5.0)[0][0]]  # the last is a result of such a program

    def count(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(count)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda x: scaled(line, x, 2.0)[0][0], values * 4))
    assert TRACED == [5.0, 2.0] and len(compiled) == 1
    assert all(np.allclose(one, 2.0 * np.asarray(values[k % 3]) * 0.5) for k, one in enumerate(together))


def test_what_is_spoken_for_stays_compiled_when_the_rest_is_dropped(folder):
    compiled, line, values = [], Timeline(jnp.asarray(0.5), 6, True), np.arange(6.0)

    def count(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    scaled(line, values, 2.0)
    jax.monitoring.register_event_duration_secs_listener(count)
    forget(lambda kinds: kinds == {Timeline})
    jax.clear_caches()
    assert np.allclose(scaled(line, values, 2.0)[0][0], values) and not compiled
    forget(lambda kinds: Timeline not in kinds)
    jax.clear_caches()
    scaled(line, values, 2.0)
    assert len(compiled) == 1 and TRACED == [2.0]
    assert np.allclose(scaled_often(line, values), 0.5 * values)
    compiled.clear()
    forget(lambda kinds: False)  # but for what lasts
    jax.clear_caches()
    assert np.allclose(scaled_often(line, 2 * values), values) and not compiled
    forget()
    scaled_often(line, values)
    assert len(compiled) == 1


def test_files_that_changed_and_programs_that_were_spoiled_are_made_anew(folder, monkeypatch):
    line, values = Timeline(jnp.asarray(0.5), 6, True), jnp.arange(6.0)
    scaled(line, values, 2.0)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    forget()
    assert np.allclose(scaled(line, values, 2.0)[0][0], np.arange(6)) and len(TRACED) == 2
    monkeypatch.setattr(programs, "_versions", lambda: "another source")
    forget()
    scaled(line, values, 2.0)
    assert len(TRACED) == 3 and len(list(folder.iterdir())) == 2


def test_classes_from_elsewhere_are_not_kept(folder):
    """An effect in a notebook may change under its name."""

    class Mine(eqx.Module):
        dt: jax.Array
        time: float = 0.0

    for _ in range(2):
        forget()
        scaled(Mine(jnp.asarray(1.0)), jnp.arange(3.0), 2.0)
    assert not folder.exists() and TRACED == [2.0]  # the usual program of this process


def test_nothing_is_kept_without_a_folder_or_without_room(folder, monkeypatch):
    line, values = Timeline(jnp.asarray(0.5), 6, True), jnp.arange(6.0)
    monkeypatch.setattr(programs, "MOST", 1)
    assert np.allclose(scaled(line, values, 5.0)[0][0], 2.5 * np.arange(6)) and not list(folder.iterdir())
    folder.rmdir()
    folder.write_text("in the way")
    assert np.allclose(scaled(line, values, 6.0)[0][0], 3.0 * np.arange(6))
    jax.config.update("jax_compilation_cache_dir", None)
    assert np.allclose(scaled(line, values, 7.0)[0][0], 3.5 * np.arange(6)) and TRACED == [5.0, 6.0, 7.0]


def test_the_folder_is_looked_through_now_and_then(folder, monkeypatch):
    looked = []
    monkeypatch.setattr(programs, "_make_room", looked.append)
    monkeypatch.setattr(programs, "MOST", 2000)
    for k in range(7):
        programs._write(folder / f"{k}.program", b"x" * 40)
    assert looked == [folder] * 3 and len(list(folder.glob("*.program"))) == 7  # the first, the fourth and the seventh


@pytest.mark.parametrize(("heavy", "at_once"), [(True, 1), (False, 3)])
def test_heavy_programs_are_compiled_one_at_a_time(monkeypatch, folder, heavy, at_once):
    """Two side by side took 2.4 GB, one after the other 1.2."""
    busy, most, together = [], [], threading.Barrier(at_once)

    def slow(function, *rest):
        def run(leaves):
            busy.append(function)
            together.wait(timeout=30)  # as many as may are in here
            most.append(len(busy))
            together.wait(timeout=30)
            busy.pop()
            return leaves

        run.heavy, run.kinds = heavy, frozenset()
        return run

    monkeypatch.setattr(programs, "_program", slow)
    functions = [kept(lambda x, k=k: x) for k in range(3)]
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda f: f(np.ones(2)), functions))
    assert most == [at_once] * 3


def test_a_kept_program_may_ask_for_another_while_it_is_traced(folder):
    inner = kept(lambda x: x + 1.0)

    @kept
    def outer(x):
        return x * jax.lax.stop_gradient(inner(np.ones(3)))

    with ThreadPoolExecutor(1) as pool:
        assert np.allclose(pool.submit(outer, np.arange(3.0)).result(timeout=60), [0.0, 2.0, 4.0])
