"""Fits side by side: order, errors, Ctrl-C."""

import os
import subprocess
import sys
import threading
import time

import pytest

from fitting.together import let_go, together
from magjax.bench import load_bench
from magjax.effects import CLASSES


def test_results_stand_in_the_order_of_the_calls():
    met = threading.Barrier(2, timeout=20)  # both must be under way at once

    def call(k):
        def run(say):
            if k < 2:
                met.wait()
            time.sleep(0.05 * (3 - k))
            return k

        return run

    assert together([call(k) for k in range(3)]) == [0, 1, 2]


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt()])
def test_an_error_ends_the_others(error):
    words, begun = [], threading.Event()

    def first(say):
        begun.wait(20)
        raise error

    def endless(say):
        while True:
            begun.set()
            say("still", len(words), None)
            time.sleep(0.01)

    with pytest.raises(type(error)):
        together([endless, first], lambda *w: words.append(w))
    assert words


def test_words_come_call_by_call_whatever_the_clock():
    met = threading.Barrier(2, timeout=20)

    def call(name):
        def run(say):
            for k in range(3):
                met.wait()  # word by word side by side
                say(name, k, None)

        return run

    words = []
    together([call("a"), call("b")], lambda *w: words.append(w))
    assert words == [(name, k, None) for name in "ab" for k in range(3)]


def test_whose_turn_it_is_speaks_at_once():
    words, heard = [], threading.Event()

    def first(say):
        say("now", 1, None)
        assert heard.wait(20)

    def tell(*word):
        words.append(word)
        heard.set()

    together([first, lambda say: say("later", 1, None)], tell)
    assert [w[0] for w in words] == ["now", "later"]


def test_what_another_makes_needless_is_ended_and_given_up():
    def endless(say):
        while True:
            say("still", 0, None)
            time.sleep(0.01)

    def needless(k, results):
        return k != 1 and results.get(1) == "serves"

    quick = together([lambda say: "done before", lambda say: time.sleep(0.1) or "serves", endless], None, needless)
    assert quick == [None, "serves", None]  # whether it was done before or not: the clock decides nothing


def test_what_an_actuator_needs_stays_in_memory(monkeypatch):
    """Its own programs, and those of the plain chain; nothing where none is named."""
    wanted = []
    monkeypatch.setattr("fitting.together.forget", wanted.append)
    monkeypatch.setattr("jax.clear_caches", lambda: None)
    lag, creep = CLASSES["sensor_lag"], CLASSES["creep"]
    base = load_bench("aa-050h").actuator()
    for actuators in ((), (base,), (base.with_effect(lag()), base.with_effect(creep()))):
        let_go(*actuators)
    told = [[keep({type(base), *kinds}) for kinds in ((), (lag,), (creep,), (lag, creep))] for keep in wanted]
    assert told == [[False] * 4, [True, False, False, False], [True, True, True, False]]


def test_programs_side_by_side_end():
    """Two at once, each with inverses of a batch: split among the threads that programs run on they would wait forever.
    They end, and give what one alone gives."""
    code = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from fitting.together import let_go, together
from magjax.bench import load_bench
from magjax.effects import CLASSES
from magjax.linear import inverse_of

run = jax.jit(lambda A: jax.lax.scan(lambda X, _: (X + 1e-3 * jax.vmap(inverse_of)(X), None), A, length=100)[0])
A = np.random.default_rng(0).standard_normal((12, 65, 65)) + 10 * np.eye(65)
alone = A
for _ in range(100):
    alone = alone + 1e-3 * np.linalg.inv(alone)
found = together([lambda _: [np.asarray(run(A)) for _ in range(15)] for _ in range(2)])
print(len(found[0] + found[1]), max(np.abs(x - alone).max() for x in found[0] + found[1]))
"""
    environment = {**os.environ, "XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200, env=environment)
    assert ended.returncode == 0, ended.stderr
    count, apart = ended.stdout.split()
    assert int(count) == 30 and float(apart) < 1e-12
