"""The page "how to add an effect", followed to the letter: its file is an effect like any other, and its lines are enough."""

import re
import shutil
import subprocess
import sys
import types
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from magjax.effects import CATALOGUE, AbstractEffect
from tests import test_effects as shared
from tests.test_simulate import actuator

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "adding_an_effect.md").read_text(encoding="utf-8")
FILE, SCRIPT = re.findall(r"```python\n(.*?)```", PAGE, re.S)
PLACE = re.search(r"Save this as `magjax/effects/(\w+)\.py`", PAGE).group(1)


@pytest.fixture
def kind(monkeypatch):
    """The effect of the page, as if its file lay in magjax/effects."""
    name = f"magjax.effects.{PLACE}"
    module = types.ModuleType(name)
    module.__package__ = "magjax.effects"
    monkeypatch.setitem(sys.modules, name, module)
    exec(compile(FILE, f"{PLACE}.py", "exec"), module.__dict__)
    found = [v for v in vars(module).values() if isinstance(v, type) and issubclass(v, AbstractEffect) and v is not AbstractEffect]
    assert len(found) == 1
    return found[0]


def test_it_is_new(kind):
    assert kind.name not in {e.name for e in CATALOGUE}


def test_at_null_the_reading_is_the_same_to_the_last_bit(kind):
    act = actuator(20)
    assert np.array_equal(np.asarray(shared.reading(act.with_effect(kind()))), np.asarray(shared.reading(act)))


def test_the_gradient_at_null_is_finite_and_not_zero(kind):
    extended = actuator(20).with_effect(kind())
    name = f"effects.{kind.name}.{kind.amplitude}"
    slope = eqx.filter_jit(lambda v: jax.jvp(lambda x: shared.reading(extended.replace({name: x})), (v,), (jnp.ones_like(v),))[1])
    column = np.asarray(slope(jnp.asarray(0.0)))
    assert np.all(np.isfinite(column)) and np.abs(column).max() > 0


def test_the_shared_table_takes_it(kind):
    shared.test_declares_what_the_documentation_needs(kind)
    shared.test_null_gradient_and_batch(kind)
    assert issubclass(kind, AbstractEffect)


def test_the_page_names_every_hook_and_its_own_lines():
    hooks = ("drive", "field_shift", "magnetization", "strain", "displacement", "reading")
    assert all(callable(getattr(AbstractEffect, hook)) and f"`{hook}(" in PAGE for hook in hooks)
    assert f"from .{PLACE} import " in PAGE and f'-k "{PLACE} or catalogue"' in PAGE


@pytest.mark.long
def test_a_newcomer_who_follows_the_page_sees_it_found(tmp_path):
    for part in ("magjax", "fitting"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "magjax" / "effects" / f"{PLACE}.py").write_text(FILE)
    listing = tmp_path / "magjax" / "effects" / "__init__.py"
    line = re.search(rf"from \.{PLACE} import (\w+)", PAGE)
    text = listing.read_text().replace("from .amplifier_lag", f"{line.group(0)}\nfrom .amplifier_lag", 1)
    listing.write_text(text.replace("    AmplifierClipping,\n", f"    AmplifierClipping,\n    {line.group(1)},\n", 1))
    (tmp_path / "try_it.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, "try_it.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    first, second = done.stdout.splitlines()[:2]
    assert first.startswith(f"attributed: {PLACE} (source) was left out") and second.startswith(PLACE)
