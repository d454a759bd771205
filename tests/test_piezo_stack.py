"""A piezo stack on the bench: voltage plays the field, polarization the magnetization, and everything speaks volts and metres."""

import json
import re

import numpy as np
import pytest
import xarray as xr

from fitting.fit import fit
from fitting.joint import data_jacobian, prior_matrix, solve
from fitting.screen import applicable
from fitting.setup import Choices, build_problem, spectra_of
from magjax.bench import load_bench
from magjax.cli import main
from magjax.effects import CATALOGUE, AmplifierLag, Creep, EddyCurrents
from magjax.errors import ConfigurationError
from magjax.inverse import PlainStack, voltage_for_displacement
from magjax.recording import load_recordings
from magjax.simulate import simulate, sweep
from tests import readme

DRIVES = ((70, 70, 1), (40, 70, 10), (55, 75, 100), (25, 40, 3), (45, 60, 30), (60, 75, 50))  # V about V at Hz; the last checks
NOISE = 4e-3  # um


def plays(voltage):
    """An independent stack: Prandtl-Ishlinskii, 240 play operators with thresholds in volts beside a straight line, um."""
    r = np.linspace(0.1, 60, 240)
    weight = np.exp(-r / 18)
    state, motion = np.zeros(len(r)), []
    for v in voltage:
        state = np.clip(state, v - r, v + r)
        motion.append(0.22 * v + 0.1 * (weight @ state) / weight.sum())
    return np.array(motion)


def recorded(folder, creep=0.0, noise=NOISE, samples=500):
    """Four settled periods of every drive as CSV in V and um; `creep`: a decade of time adds so much, on 26 lags 1 ms .. 100 s."""
    rng = np.random.default_rng(0)
    for k, (A, offset, f) in enumerate(DRIVES):
        wave = offset + A * np.sin(2 * np.pi * np.arange(6 * samples) / samples)
        y = plays(np.concatenate([np.linspace(0, offset, 50), wave]))[50 + 2 * samples :]
        v, t = wave[2 * samples :], np.arange(4 * samples) / samples / f
        s = 2j * np.pi * np.fft.rfftfreq(len(y), 1 / samples / f)
        late = sum(1 / (1 + s * tau) for tau in np.geomspace(1e-3, 100, 26)) * 5 / 26
        y = np.fft.irfft(np.fft.rfft(y) * (1 + creep * late), len(y)) + noise * rng.standard_normal(len(y))
        rows = np.stack([t, v, y], 1)
        np.savetxt(folder / f"pz_{k}.csv", rows, delimiter=",", header="time_s,voltage_V,displacement_um", comments="")
    return [str(p) for p in sorted(folder.glob("pz_*.csv"))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("stack")
    recorded(path)
    return path


@pytest.fixture(scope="module")
def fitted(folder):
    """(content of fit.json, result folder) of five recordings, the sixth foretold."""
    *files, check = [str(p) for p in sorted(folder.glob("pz_*.csv"))]
    out = folder / "result"
    assert main(["fit", *files, "--bench", "piezo-stack", "--check", check, "--out", str(out), "--quiet"]) == 0
    return json.loads((out / "fit.json").read_text()), out


def test_play_operators_are_fitted_to_their_noise_and_a_held_out_loop_is_foretold(fitted):
    content, _ = fitted
    assert content["chi2_per_sample"] < 1.1 and content["converged"]
    # the line of the generator in the bench's terms: 0.22 um/V of 42 um / 150 V
    assert abs(content["parameters"]["piezo.chi"]["value"] - 0.22 * 150 / 42) < 5e-3
    (row,) = content["check"]
    assert row["channel"] == "displacement" and row["unit"] == "m"
    assert row["rms_after"] < 2 * 1e-6 * NOISE  # its level too, which hangs on relays that the others never reach
    assert 5 < content["effective_unknowns"] < 150


def test_everything_speaks_volts_and_metres(fitted, folder, capsys, tmp_path):
    content, out = fitted
    page = re.sub(r"base64,[A-Za-z0-9+/=\s]*", "", (out / "report.html").read_text())  # pictures hold any letters
    assert "A/m" not in page and "magneti" not in page and "voltage / V" in page and "displacement / µm" in page
    assert "A/m" not in json.dumps(content)
    assert main(["check", str(folder / "pz_0.csv"), "--bench", "piezo-stack"]) == 0
    assert "voltage 0 .. 140 V" in capsys.readouterr().out
    run = tmp_path / "run.nc"
    said = ["simulate", "--model", str(out), "--amplitude", "50", "--offset", "60", "--out", str(run), "--quiet"]
    assert main(said) == 0
    with xr.open_dataset(run) as data:
        units = {n: data[n].attrs["units"] for n in data.data_vars}
    assert units == {
        "command": "V",
        "voltage": "V",
        "polarization": "V",
        "free_displacement": "m",
        "displacement": "m",
        "reading": "m",
    }
    assert main([*said[:3], "--amplitude", "200", "--out", str(run)]) == 2
    assert "leads the voltage to -200..200 V" in capsys.readouterr().err


def test_a_sweep_tells_no_magnetic_loss():
    data = sweep(load_bench("piezo-stack").actuator(), [1.0, 10.0], [20.0, 40.0], [60.0], keep=True)
    assert "loss" not in data and data["peak_to_peak"].attrs["units"] == "m" and "voltage" in data
    # no rate in it: both frequencies give one loop
    np.testing.assert_allclose(data["peak_to_peak"][0], data["peak_to_peak"][1], rtol=1e-6)


def test_the_law_of_the_stack():
    """u = stroke (Gamma[V] + chi V) / V_m, against the operator in NumPy; far below f0 the displacement is the same."""
    actuator = load_bench("piezo-stack").actuator()
    drive = 70 + 60 * np.sin(2 * np.pi * np.arange(200) / 200)
    signals = simulate(actuator, drive, 1e-2)
    operator = PlainStack.from_actuator(actuator).operator
    P = np.array([operator.apply(v) for v in drive]) + float(actuator.piezo.chi) * drive
    np.testing.assert_allclose(np.asarray(signals.magnetization), P, atol=1e-10)
    np.testing.assert_allclose(np.asarray(signals.free_displacement), 42e-6 * P / 150, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(signals.displacement), 42e-6 * P / 150, atol=1e-9)


def test_the_voltage_for_a_wanted_displacement_leads_there(fitted, tmp_path, capsys):
    _, out = fitted
    t = np.arange(400) * 1e-3
    wanted = 20 + 8 * np.sin(2 * np.pi * 5 * t) + 4 * np.sin(2 * np.pi * 12.5 * t)  # um
    np.savetxt(tmp_path / "wanted.csv", np.stack([t, wanted], 1), delimiter=",", header="time_s,displacement_um", comments="")
    assert main(["invert", str(tmp_path / "wanted.csv"), "--model", str(out), "--out", str(tmp_path / "voltage.csv")]) == 0
    assert " V; wrote" in capsys.readouterr().out
    with open(tmp_path / "voltage.csv") as stream:
        assert stream.readline().strip() == "time_s,voltage_V"
        voltage = np.loadtxt(stream, delimiter=",")[:, 1]
    from magjax.model_file import load_model

    reached = 1e6 * np.asarray(simulate(load_model(out)[0], voltage, 1e-3).displacement)
    assert np.abs(reached - wanted).max() < 1e-4  # of 24 um
    np.savetxt(tmp_path / "far.csv", np.stack([t, wanted + 300], 1), delimiter=",", header="time_s,displacement_um", comments="")
    assert main(["invert", str(tmp_path / "far.csv"), "--model", str(out), "--out", str(tmp_path / "far_voltage.csv")]) == 3
    assert "the stack moves between" in capsys.readouterr().err


def test_the_lag_of_the_amplifier_is_made_up_for():
    actuator = load_bench("piezo-stack").actuator()
    lagging = actuator.with_effect(AmplifierLag(tau=2e-3))
    t = np.arange(2000) * 1e-4
    wanted = 2e-5 + 5e-6 * np.sin(2 * np.pi * 20 * t)
    missed = []
    for plant in (actuator, lagging):
        voltage, beyond = voltage_for_displacement(PlainStack.from_actuator(plant), wanted, 1e-4)
        assert not beyond.any()
        missed.append(np.abs(np.asarray(simulate(lagging, voltage, 1e-4).displacement) - wanted)[500:].max())
    assert missed[1] < 0.05 * missed[0] and missed[0] > 5e-7


def test_beyond_the_plane_the_nearest_voltage_is_taken():
    plant = PlainStack.from_actuator(load_bench("piezo-stack").actuator())
    voltage, beyond = voltage_for_displacement(plant, np.linspace(0, 1.5 * plant.range[1], 50), 1e-2)
    assert beyond[-1] and not beyond[0] and voltage[-1] == plant.operator.high and np.all(np.diff(voltage) >= 0)


def test_effects_of_coil_and_magnetization_are_not_offered():
    actuator = load_bench("piezo-stack").actuator()
    offered = {e.name for e in applicable(actuator)}
    assert {"creep", "amplifier_lag", "sensor_lag", "second_mode", "rate_dependent_switching"} <= offered
    never = {e.name for e in CATALOGUE} - offered
    assert {
        "eddy_currents",
        "field_diffusion",
        "quartic_magnetostriction",
        "delta_e",
        "thermal_drift",
        "inductive_crosstalk",
    } <= never
    with pytest.raises(ConfigurationError, match="eddy_currents acts in a rod or its coil"):
        actuator.with_effect(EddyCurrents())
    assert actuator.with_effect(Creep()).effects
    for effect in applicable(actuator):
        for name, (_, info) in actuator.with_effect(effect()).parameters().items():
            assert "A" not in info.unit, name


BENCH = "[piezo]\nstroke = 4e-5\nV_m = 150\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[piezo]\nV_m = 150", "does not state stroke; write the data sheet's stroke"),
        (BENCH + "[coil]\nk_eddy = 0", r"\[coil\] beside \[piezo\]"),
        (BENCH + '[fit]\noutput = "polarization"', "does not state P_m"),
        (BENCH + '[fit]\noutput = "flux_density"', "is not read of a stack"),
        (BENCH + "[limits]\ncurrent_A = 1", "bounds a bench driven by a current; give limits.voltage_V"),
        ('[coil]\nk_eddy = 0\n[fit]\noutput = "polarization"', r"needs \[piezo\]"),
    ],
)
def test_a_wrong_bench_is_one_line_with_its_mend(text, words, tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=words):
        load_bench(path)


@pytest.mark.long
def test_a_polarization_loop_of_a_ferroelectric_sample(tmp_path):
    """The chain ends early: P in C/m^2, of a few hard-switching relays beside a dielectric line."""
    bench = tmp_path / "film.toml"
    bench.write_text('[piezo]\nV_m = 10\nP_m = 0.3\nchi = 0.1\n[limits]\nvoltage_V = 10\n[fit]\noutput = "polarization"\n')
    t = np.arange(2000) / 500
    files = []
    for k, A in enumerate((9.9, 7, 5)):
        v = A * np.sin(2 * np.pi * t)
        up, s = np.linspace(0.5, 9.5, 200), -np.ones(200)
        P = []
        for x in np.concatenate([v, v]):
            s = np.where(x > up, 1.0, np.where(x < -up, -1.0, s))
            P.append(0.2 * np.mean(s) + 0.005 * x)
        y = 100 * np.array(P[2000:]) + 0.05 * np.random.default_rng(k).standard_normal(2000)  # uC/cm^2
        files.append(tmp_path / f"film_{k}.csv")
        rows = np.stack([t, v, y], 1)
        np.savetxt(files[-1], rows, delimiter=",", header="time_s,voltage_V,polarization_uC_per_cm2", comments="")
    recordings = load_recordings(files, bench)
    assert np.ptp(recordings[0].channels["polarization"]) == pytest.approx(0.47, abs=0.05)

    result = fit(recordings, str(bench), refine=False)
    assert {r.unit for r in result.recordings} == {"C/m^2"}
    assert max(r.residual_rms for r in result.recordings) < 0.02 * 0.47


@pytest.mark.long
def test_the_normal_matrix_is_that_of_the_weights_returned(tmp_path):
    """What a fit counts as unknowns is normal less prior: with weights that moved after the last step it fell below zero."""

    bench = load_bench("piezo-stack")
    spectra = spectra_of(load_recordings(recorded(tmp_path, noise=0.1)[1:3], bench), bench)
    problem, z = build_problem(
        spectra, bench.actuator(), bench, ("piezo.chi",), Choices(level=20, knots=(7, 6), coarse=100, fine=200, rest="negative")
    )
    found = solve(problem, z, (1e2,) * len(problem.penalties), max_jacobians=4)
    left = found.normal - prior_matrix(problem, found.weights)
    J = data_jacobian(problem, z)
    assert np.linalg.eigvalsh(left).min() > -1e-6 * np.linalg.eigvalsh(J.T @ J).max()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["emulate", "--bench", "piezo-stack", "--link", "none"], "is driven by a voltage, these devices by a current"),
        (["control", "design", "--bench", "piezo-stack"], "magjax invert gives the voltage"),
    ],
)
def test_what_a_stack_cannot_do_is_one_line(command, words, capsys):
    assert main(command) == 2
    assert words in capsys.readouterr().err


@pytest.mark.long
def test_creep_that_was_concealed_is_named(tmp_path):
    from fitting import diagnose

    *fitted, check = load_recordings(recorded(tmp_path, creep=0.015), "piezo-stack")
    found = diagnose(fitted, "piezo-stack", check=[check])
    assert found.verdict == "attributed" and [e["name"] for e in found.effects] == ["creep"]
    assert found.check[0]["rms_after"] < 2e-6 * NOISE < found.check[0]["rms_before"]
    assert found.effects[0]["parameters"]["gain"]["value"] == pytest.approx(0.015, rel=0.2)
    assert not {c.name for c in found.candidates} & {"eddy_currents", "magnetic_aftereffect", "thermal_drift"}


@pytest.mark.long
def test_the_page_of_transducers_is_true(tmp_path):
    """Its script and commands are typed as they stand; what comes back has the shape that it states."""
    wrong = []
    for block in readme.blocks((readme.ROOT / "docs" / "transducers.md").read_text(encoding="utf-8")):
        if block.kind == "file":
            (tmp_path / block.target).write_text(block.content)
        else:
            wrong += [readme.differs(expected, readme.run(command, tmp_path), block) for command, expected in block.steps()]
    assert wrong and not [w for w in wrong if w]
