"""The main job on measured loops: a rod with eddy currents, quasi-static families of steel and ferrite."""

import dataclasses

import numpy as np
import pytest

from fitting.check import check_errors
from fitting.fit import fit
from magjax.bench import load_bench
from magjax.recording import load_recordings


def test_rod_from_raw_captures_predicts_the_frequency_left_out(measured):
    bench = load_bench("rod-eddy")
    runs = load_recordings([str(measured / f"rod_eddy/captures_f0{f}.csv") for f in (10, 20, 50)], bench)
    found = fit([runs[0], runs[2]], bench, refine=False)
    k = found.estimate("coil.k_eddy")
    # the loss per cycle grows by 0.0514 (10 to 20 Hz) and 0.0551 (20 to 50 Hz) times the integral of (dB/dt)^2
    assert abs(k.value - 0.053) < 0.004 and 3e-4 < k.stderr < 3e-3
    row = check_errors(found.actuator, found.actuator, [runs[1]], bench)[0]
    assert row["rms_after"] < 1.3 * row["noise_rms"]
    static = dataclasses.replace(bench, free=("hysteresis.masses",), constants={**bench.constants, "coil.k_eddy": 0.0})
    plain = fit([runs[0], runs[2]], static, refine=False)
    before = check_errors(plain.actuator, plain.actuator, [runs[1]], bench)[0]
    assert before["rms_after"] > 1.4 * row["rms_after"]


@pytest.mark.long
@pytest.mark.parametrize(("family", "left_out", "share"), [("steel_m130_27s", 1, 0.1), ("ferrite_mnzn", 2, 0.03)])
def test_a_loop_left_out_is_predicted(measured, family, left_out, share):
    bench = load_bench("material-loops")
    runs = load_recordings([str(measured / family / "loops.csv")], bench)
    kept = [r for k, r in enumerate(runs) if k != left_out]
    found = fit(kept, bench)
    row = check_errors(found.actuator, found.actuator, [runs[left_out]], bench)[0]
    assert row["rms_after"] < share * np.std(runs[left_out].channels["flux_density"])
