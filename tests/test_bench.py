"""Bench files: what is wrong in one is one line with the file, the key and the mend; a start state may be a history of fields."""

import dataclasses
import json

import numpy as np
import pytest

from fitting.result import model_as_dict
from magjax.bench import built_in_benches, load_bench
from magjax.cli import main
from magjax.effects.field_diffusion import DiffusionModes
from magjax.errors import ConfigurationError
from magjax.model_file import load_model
from magjax.preisach import Preisach
from magjax.simulate import simulate

COIL = "[coil]\nR_eddy = 70\nc0 = 1.54e4\nH_bias = 1.23e4\nN_m = 1300\nA_m = 2.83e-5\n"
ROD = "[magnetostriction]\nlambda_s = 1e-3\nM_s = 7e5\nl_rod = 0.05\n"


def written(folder, text):
    path = folder / "bench.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 3", r'name = "3"'),
        ("coil = 3", r"written \[coil\]"),
        ("columns = 3", r"columns = 3 .* \[columns.QUANTITY\]"),
        ("[columns]\nfield = 3", r"columns.field = 3 must be a section"),
        ('[columns.field]\nscale = "x"', r"columns.field.scale = 'x' must be a finite number"),
        ("[columns.field]\nscale = 0", "columns.field.scale = 0"),
        ("[columns.field]\nname = 3", "columns.field.name = 3 must be text"),
        ('[columns.time]\nmerge = "yes"', "columns.time.merge = 'yes' must be true or false"),
        ("[columns.flux_density]\nemf_turns = 10", r"\[columns.flux_density\] has no emf_area"),
        ("[columns.flux_density]\nemf_turns = 0\nemf_area = 1e-6", "emf_turns = 0; give a positive"),
        ("[columns.flux_density]\nemf_turns = 9\nemf_area = 1e-6\nemf_sign = 3", "emf_sign = 3; give 1 or -1"),
        ('[limits]\ncurrent_A = "x"', "limits.current_A = 'x' must be a finite number"),
        ("[limits]\ncurrent_A = -0.9", "limits.current_A = -0.9; give a positive"),
        ("[limits]\nfield_A_per_m = 300", "give limits.current_A"),
        ("[limits]\ncurrent_A = 1e-12", "limits.current_A = 1e-12 drives nothing; give the largest"),
        (COIL + ROD + '[fit]\noutput = "strain"', r"which nothing drives; take \[coil\] away"),
        ('[fit]\noutput = "velocity"', "fit.output = 'velocity' is unknown"),
        ('[fit]\noutput = "displacement"', r"needs \[magnetostriction\]"),
        ('[fit]\nfree = "coil.R_eddy"', r'write free = \["coil.R_eddy"\]'),
        ('[fit]\npriors = {x = "x"}', 'fit.priors names "x"'),
        ("[fit]\npriors = [1]", "must be a section"),
        ('[fit.priors]\n"coil.Reddy" = 1', 'did you mean "coil.R_eddy"'),
        ('[fit.priors]\n"coil.R_eddy" = 0', "give a positive value"),
        ("[fit.priors]\ncoil.R_eddy = -1", '"coil.R_eddy" = -1; give a positive value'),
        ('[fit.priors]\n"coil.R_eddy" = "x"', "must be a finite number"),
        (COIL.replace("70", "nan"), "coil.R_eddy = nan must be a finite number"),
        (COIL.replace("70", "inf"), "coil.R_eddy = inf must be a finite number"),
        (COIL + "[mechanics]\nf0 = 392\nxi = 1", r"without \[magnetostriction\]"),
        (COIL + "k_eddy = 0.1", "coil.R_eddy does nothing beside coil.k_eddy"),
        ("[hysteresis]\nstart = [1.0, 'x']", r"hysteresis.start\[1\] = 'x'"),
        ("[hysteresis]\nstart = 'demagnetised'", 'did you mean "demagnetized"'),
    ],
)
def test_what_is_wrong_is_told_in_one_line(tmp_path, text, words):
    path = written(tmp_path, text)
    with pytest.raises(ConfigurationError, match=words) as error:
        load_bench(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["[limits]\ncurrent_A = 1.0\n", COIL + '[fit.priors]\n"effects.excess_loss.nothing" = 1'])
def test_what_only_an_actuator_needs_is_told_by_it(tmp_path, text):
    path = written(tmp_path, text)
    bench = load_bench(path)
    with pytest.raises(ConfigurationError, match="has no .coil.|which no effect has") as error:
        bench.actuator()
    assert str(path) in str(error.value)


def test_a_prior_may_be_written_with_or_without_quotes(tmp_path):
    for name in ('"coil.R_eddy"', "coil.R_eddy"):
        assert load_bench(written(tmp_path, f"\ufeff{COIL}[fit.priors]\n{name} = 2")).priors == {"coil.R_eddy": 2.0}


def test_constants_that_are_not_stated_are_told(tmp_path, capsys):
    path = written(tmp_path, COIL.replace("c0 = 1.54e4\n", "") + ROD + "[mechanics]\nf0 = 392")
    assert load_bench(path).assumed == ("coil.c0", "mechanics.xi")
    main(["simulate", "--bench", str(path), "--frequency", "10", "--amplitude", "0.1", "--out", str(tmp_path / "run.nc")])
    said = capsys.readouterr().err
    assert "does not state coil.c0 (15400 1/m), mechanics.xi (0.7783)" in said and str(path) in said


def test_built_in_benches_hold():
    for name in built_in_benches():
        bench = load_bench(name)
        assert not bench.assumed
        assert bench.output == "strain" or bench.actuator().hysteresis.cells == bench.levels


def test_a_start_may_be_a_history_of_fields(tmp_path):
    """The list reaches the operator, a simulation, and a model that is written and read."""
    history = (20000.0, 4000.0, 15000.0)
    bench = load_bench(written(tmp_path, COIL + ROD + f"[hysteresis]\nstart = {list(history)}\n"))
    assert bench.start == history
    actuator, plain = bench.actuator(), dataclasses.replace(bench, start="auto").actuator()
    h = plain.hysteresis
    same = dataclasses.replace(plain, hysteresis=Preisach(h.masses, h.low, h.high, h.offset, history))
    drive = 0.1 * np.sin(np.arange(200) / 20)
    a, b, c = (np.asarray(simulate(x, drive, 1e-4).magnetization) for x in (actuator, same, plain))
    assert np.array_equal(a, b) and np.abs(a - c).max() > 1e3
    (tmp_path / "model.json").write_text(json.dumps(model_as_dict(actuator, bench)))
    read, again = load_model(tmp_path)
    assert again == bench and np.array_equal(np.asarray(simulate(read, drive, 1e-4).magnetization), a)


def test_a_law_is_read_in_the_form_that_was_written(tmp_path):
    """The modes of a solid rod have a time, its shells have none."""
    bench = load_bench("aa-050h")
    actuator = bench.actuator().with_effect(DiffusionModes(kappa=0.7, tau=2e-4))
    (tmp_path / "model.json").write_text(json.dumps(model_as_dict(actuator, bench)))
    (effect,) = load_model(tmp_path)[0].effects
    assert type(effect) is DiffusionModes and (float(effect.kappa), float(effect.tau)) == (0.7, 2e-4)


def test_a_model_that_does_not_hold_is_told_with_its_file(tmp_path):
    bench = load_bench("aa-050h")
    whole = model_as_dict(bench.actuator(), bench)
    path = tmp_path / "model.json"
    masses = [[-1.0, 0.0], [1.0, 1.0]]
    for change, words in (
        ({"hysteresis": {**whole["hysteresis"], "masses": masses}}, r"masses\[0, 0\] is negative.*mend it there, or fit again"),
        ({"hysteresis": {}}, "no 'masses'"),
        ({"bench": {**whole["bench"], "output": "velocity"}}, "bench.output = 'velocity' is unknown; known are displacement"),
        ({"bench": {**whole["bench"], "drive": "torque"}}, "bench.drive = 'torque' is unknown; known are current"),
        ({"bench": 3}, "not a fitted model"),
        ({"effects": ["nothing"]}, "no 'nothing'"),
    ):
        path.write_text(json.dumps({**whole, **change}))
        with pytest.raises(ConfigurationError, match=words) as error:
            load_model(tmp_path)
        assert str(path) in str(error.value) and "\n" not in str(error.value)
