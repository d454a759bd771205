"""Concealed effects one by one, strong and weak, on smooth and rough densities: the README's table (long).

The benches use the project's simulator (finer plane, other density, other constants): they test the search, not the laws.
"""

import numpy as np
import pytest

from fitting.demo import concealed_actuator, record
from fitting.diagnose import diagnose
from magjax.bench import load_bench
from magjax.effects import CLASSES

DRIVES = (
    (10, 0.8, 0.1),
    (20, 0.5, -0.2),
    (50, 0.8, 0.1),
    (80, 0.5, -0.2),
    (120, 0.8, 0.1),
    (160, 0.5, -0.2),
    (200, 0.8, 0.1),
    (250, 0.5, -0.2),
    (300, 0.8, 0.1),
)
CASES = [
    ("excess_loss", {"k": 30.0, "rate_knee": 5.0}, False),
    ("coulomb_friction", {"f": 8e-8, "v_s": 1e-4}, True),
    ("sensor_lag", {"tau": 2e-5, "order2": 0.5}, True),
    ("amplifier_lag", {"tau": 8e-5}, False),
    ("quartic_magnetostriction", {"b": 0.05}, True),
    ("delta_e", {"e": 0.1}, False),
    ("second_mode", {"gain": 0.006, "f2": 800.0, "xi2": 0.05}, True),
    ("field_diffusion", {"kappa": 0.5}, False),
    ("creep", {"gain": 0.004}, False),
    ("backlash", {"gap": 9e-8}, True),
    ("duffing_stiffness", {"k3": 0.03}, True),
    ("inductive_crosstalk", {"kappa": 3e-10}, False),
    ("rate_dependent_switching", {"gamma": 9.0, "rate0": 1e5}, True),
    ("structural_damping", {"eta": 0.006, "dispersion": 0.0, "exponent": 1e-3}, False),
    ("stress_feedback", {"stiffness": 2e9}, False),
    ("magnetic_aftereffect", {"share": 0.006}, True),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "parameters", "rough"), CASES, ids=[c[0] for c in CASES])
def test_concealed_effect_is_named(name, parameters, rough):
    bench = load_bench("aa-050h")
    rng = np.random.default_rng(11)
    truth = concealed_actuator(bench, CLASSES[name](**parameters), rough)
    found = diagnose(
        [record(truth, *d, rng, f"r{d[0]}") for d in DRIVES], bench, check=[record(truth, 400, 0.6, 0.05, rng, "check")]
    )
    print(f"\n{name} ({'rough' if rough else 'smooth'}): {found}")
    named = {e["name"] for e in found.effects} | {n for g in found.groups for n in g}
    assert name in named
    assert found.verdict in ("attributed", "group")


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rough", [False, True])
def test_nulls_stay_silent(seed, rough):
    bench = load_bench("aa-050h")
    rng = np.random.default_rng(seed)
    truth = concealed_actuator(bench, rough=rough)
    found = diagnose([record(truth, *d, rng, f"r{d[0]}") for d in DRIVES], bench)
    print(f"\nnull ({'rough' if rough else 'smooth'}, seed {seed}): {found}")
    assert found.verdict == "nothing_missing"
