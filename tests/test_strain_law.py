"""Static strain curves: the law and the variable that its coefficients follow."""

import json

import numpy as np
import pytest

from fitting.strain_law import Curves, diagnose_strain, fit_law, load_curves, strain_verdict
from magjax.bench import load_bench
from magjax.cli import main
from magjax.constants import MU0
from magjax.errors import RecordingError


def invented(law, noise=2e-8):
    rng = np.random.default_rng(0)
    stress = np.repeat(np.linspace(-40e6, 60e6, 9), 40)
    M = np.tile(np.linspace(0, 1.3e6, 40), 9)
    H = 50 + 900 * (M / 1.3e6) ** 5 * (1 + 0.2 * stress / 60e6)
    strain = law(M / 1.3e6, stress) + noise * rng.standard_normal(len(M))
    return Curves(M, strain, {"stress": stress, "field": H}, np.unique(stress, return_inverse=True)[1], 1.3e6)


def test_the_square_law_is_kept_where_it_serves():
    found = strain_verdict(invented(lambda m, s: 8e-6 * m**2))
    assert found["verdict"] == "nothing_missing" and not found["effects"]


def test_a_quartic_law_is_named_without_a_variable():
    best, tried = diagnose_strain(invented(lambda m, s: 8e-6 * m**2 - 5e-6 * m**4))
    assert (best.name, best.variable) == ("quartic", None)
    assert best.coefficients[0] == pytest.approx([8e-6, -5e-6], rel=0.02) and best.held_out < 0.2 * tried["square", None].held_out


def test_stress_is_named_with_its_passage():
    best, _ = diagnose_strain(invented(lambda m, s: 4e-6 * m**2 * (1 - 1.5 * np.tanh((s - 1e7) / 1.5e7))))
    assert (best.name, best.variable) == ("square", "stress")
    assert best.center == pytest.approx(1e7, rel=0.05) and best.width == pytest.approx(1.5e7, rel=0.05)
    assert best.held_out < 4e-8


def test_measured_sheet(measured, tmp_path, capsys):
    source = str(measured / "fesi_magnetostriction/lambda.csv")
    assert main(["diagnose", source, "--bench", "strain-curves", "--out", str(tmp_path), "--quiet"]) == 0
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert [e["name"] for e in found["effects"]] == ["quartic_magnetostriction", "stress_dependent_magnetostriction"]
    errors = {(r["law"], r["variable"]): r["held_out_rms"] for r in found["laws"]}
    assert errors["sextic", "stress"] < 0.07 * errors["square", None] and errors["quartic", "field"] > 0.9 * errors["square", None]
    assert "found wanting" in capsys.readouterr().out and (tmp_path / "strain.png").stat().st_size > 10_000
    curves = load_curves([source], load_bench("strain-curves"))
    assert curves.curve.max() == 16 and np.ptp(curves.variables["stress"]) == pytest.approx(135e6)
    with pytest.raises(Exception, match="square, quartic, sextic"):
        fit_law(curves, "cubic")


def test_tables_that_cannot_be_read_say_so(tmp_path):
    bench = load_bench("strain-curves")
    path = tmp_path / "curves.csv"
    path.write_text("sigma_MPa,B_T,lambda_ppm\n0,0.1,0.2\n")
    with pytest.raises(RecordingError, match="magnetization, or flux density and field"):
        load_curves([path], bench)
    path.write_text("sigma_MPa,B_T,H_A_per_m\n0,0.1,0.2\n")
    with pytest.raises(RecordingError, match="no column lambda_ppm"):
        load_curves([path], bench)
    rows = "".join(f"{s},{b},{b / MU0 / 1e3},{b}\n" for s in (0, 5) for b in (0.1, 0.5, 1.0))
    path.write_text("sigma_MPa,B_T,H_A_per_m,lambda_ppm\n" + rows)
    with pytest.raises(RecordingError, match="2 curves"):
        load_curves([path], bench)
