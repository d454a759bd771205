"""A supply of limited voltage: the screening tries it with the voltage that the rod's own flux makes."""

import numpy as np
import pytest

from fitting.demo import concealed_actuator, record
from fitting.fit import fit
from fitting.screen import screened
from magjax.bench import load_bench
from magjax.effects import AmplifierClipping

BENCH = load_bench("aa-050h")
DRIVES = ((20, 0.8, 0.1), (60, 0.8, 0.0), (120, 0.7, 0.1), (250, 0.8, 0.1))


@pytest.mark.long
def test_a_limit_that_the_flux_of_the_rod_runs_into_scores_first():
    """A coil of a few ohm: the voltage goes with the hysteresis, R dI/dt of no coil looks like it."""
    truth, rng = concealed_actuator(BENCH, AmplifierClipping(inverse_limit=0.08, tau_L=3e-4, linkage=3e-2)), np.random.default_rng(8)
    base = fit([record(truth, *drive, rng, f"{drive[0]} Hz") for drive in DRIVES], BENCH, refine=False)
    first, *others = screened(base, base.choices)
    assert first.name == "amplifier_clipping" and first.shapes.get("linkage", 0.0) > 0
    assert first.z > 15 and first.z > 1.1 * abs(others[0].z)
