"""The main job on measured loops: a rod with eddy currents, quasi-static families of steel and ferrite."""

import dataclasses

import numpy as np
import pytest

from fitting.check import check_errors
from fitting.diagnose import diagnose
from fitting.fit import fit
from fitting.scale import profile_intervals
from magjax.bench import load_bench
from magjax.effects import CATALOGUE
from magjax.recording import load_recordings


def test_rod_from_raw_captures_predicts_the_frequency_left_out(measured):
    bench = load_bench("rod-eddy")
    runs = load_recordings([str(measured / f"rod_eddy/captures_f0{f}.csv") for f in (10, 20, 50)], bench)
    found = fit([runs[0], runs[2]], bench, refine=False)
    k = found.estimate("coil.k_eddy")
    # the loss per cycle grows by 0.0514 (10 to 20 Hz) and 0.0551 (20 to 50 Hz) times the integral of (dB/dt)^2
    assert abs(k.value - 0.053) < 0.004 and 3e-4 < k.stderr < 5e-3
    row = check_errors(found.actuator, found.actuator, [runs[1]], bench)[0]
    assert row["rms_after"] < 1.3 * row["noise_rms"]
    static = dataclasses.replace(bench, free=("hysteresis.masses",), constants={**bench.constants, "coil.k_eddy": 0.0})
    plain = fit([runs[0], runs[2]], static, refine=False)
    before = check_errors(plain.actuator, plain.actuator, [runs[1]], bench)[0]
    assert before["rms_after"] > 1.4 * row["rms_after"]


def test_the_stated_error_of_the_rod_is_that_of_a_profile(measured):
    """The slope by k on the Jacobian's grid, which alone promises 0.001, is three times what a tenth of k changes on the fine one."""
    bench = load_bench("rod-eddy")
    runs = load_recordings([str(measured / f"rod_eddy/captures_f0{f}.csv") for f in (10, 20, 50)], bench)
    found = fit(runs, bench)
    k = found.estimate("coil.k_eddy")
    low, high = profile_intervals(found).interval("coil.k_eddy")
    assert low < 0.0522 < high and low < k.value < high  # 0.0522: another path of the solver ended there
    assert 0.7 < k.stderr / ((high - low) / (2 * 1.96)) < 1.4


@pytest.mark.long
@pytest.mark.parametrize(("family", "left_out", "share"), [("steel_m130_27s", 1, 0.1), ("ferrite_mnzn", 2, 0.03)])
def test_a_loop_left_out_is_predicted(measured, family, left_out, share):
    bench = load_bench("material-loops")
    runs = load_recordings([str(measured / family / "loops.csv")], bench)
    kept = [r for k, r in enumerate(runs) if k != left_out]
    found = fit(kept, bench)
    row = check_errors(found.actuator, found.actuator, [runs[left_out]], bench)[0]
    assert row["rms_after"] < share * np.std(runs[left_out].channels["flux_density"])


RATES = {"coil", "source", "mechanics", "sensor"} | {"magnetic_aftereffect", "rate_dependent_switching", "creep", "field_diffusion"}


def claimed(found):
    """Names of what a diagnosis says is or may be missing."""
    return {e["name"] for e in found.effects} | {n for g in found.groups for n in g}


@pytest.mark.long
@pytest.mark.parametrize("frequencies", [(10, 50), (10, 20, 50)])
def test_concealed_eddy_currents_of_the_rod_are_found(measured, frequencies):
    bench = load_bench("rod-eddy")
    bench = dataclasses.replace(bench, free=tuple(n for n in bench.free if n != "coil.k_eddy"))
    every = {f: load_recordings([str(measured / f"rod_eddy/captures_f0{f}.csv")], bench)[0] for f in (10, 20, 50)}
    check = [r for f, r in every.items() if f not in frequencies]
    concealed = bench.actuator().replace({"coil.k_eddy": 0.0})
    found = diagnose([every[f] for f in frequencies], bench, check=check, actuator=concealed)
    assert "eddy_currents" in claimed(found), str(found)
    if check:  # by itself, or at the head of a group with a delay or a lag of the pick-up
        sizes = {e["name"]: e["parameters"] for e in found.effects} | found.rivals
        assert set(sizes) <= {"eddy_currents", "transport_delay", "sensor_lag"} and next(iter(sizes)) == "eddy_currents", str(found)
        k = sizes["eddy_currents"]["k"]
        assert abs(k["value"] - 0.053) < 0.004 and 1e-3 < k["stderr"] < 1e-2  # half of a profile's interval is 0.004, widened beside an effect
        assert found.check[0]["rms_after"] < 0.75 * found.check[0]["rms_before"]


@pytest.mark.long
def test_nothing_is_missing_where_the_eddy_currents_are_in_the_base(measured):
    bench = load_bench("rod-eddy")
    runs = load_recordings([str(measured / f"rod_eddy/captures_f0{f}.csv") for f in (10, 20, 50)], bench)
    found = diagnose(runs, bench)
    assert found.verdict == "nothing_missing", str(found)


@pytest.mark.long
@pytest.mark.parametrize("family", ["steel_m130_27s", "ferrite_mnzn"])
def test_nothing_that_depends_on_rate_is_claimed_of_quasistatic_loops(measured, family):
    bench = load_bench("material-loops")
    runs = load_recordings([str(measured / family / "loops.csv")], bench)
    found = diagnose(runs, bench)
    blocks = {c.name: c.block for c in CATALOGUE}
    assert not {n for n in claimed(found) if n in RATES or blocks[n] in RATES}, str(found)
