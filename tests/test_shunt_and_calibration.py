"""Instruments recorded by themselves: the amplifier by its shunt, the sensor by a calibration, a filter that the bench file states."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.instruments import (
    exchange,
    filter_as_mode,
    has_shunt,
    known_instruments,
    measured_sensor,
    measured_source,
    mode_as_filter,
    on_command,
)
from magjax.bench import load_bench
from magjax.errors import ConfigurationError, RecordingError
from magjax.readers import load_calibrations, load_recordings
from magjax.recording import Recording
from magjax.writers import write_recording

BENCH = "aa-050h"


def passed(law, frequency, drive, output, size, noise, seed=0, samples=400):
    """Four periods of a sine and what a linear `law` makes of it, with noise."""
    rng = np.random.default_rng(seed + int(frequency))
    phase = 2 * np.pi * np.arange(4 * samples) / samples
    gain = law(2j * np.pi * frequency)
    channels = {
        drive: size * np.sin(phase),
        output: size * np.imag(gain * np.exp(1j * phase)) + noise * rng.standard_normal(len(phase)),
    }
    return Recording(phase / (2 * np.pi * frequency), channels, {}, {}, f"{frequency} Hz")


def shunts(law, frequencies=(10, 50, 150, 300)):
    made = [passed(law, f, "command", "current", 0.5, 1e-4) for f in frequencies]
    return [dataclasses.replace(r, channels={**r.channels, "displacement": 1e-5 * np.sin(np.arange(len(r.time)))}) for r in made]


@pytest.mark.parametrize(
    ("law", "verdict", "order2"),
    [
        (lambda s: 0.99 + 0 * s, "follows", None),
        (lambda s: 1 / (1 + 9e-5 * s), "amplifier_lag", None),
        (lambda s: 1 / (1 + 4.5e-5 * s) ** 2, "amplifier_lag", 0.25),
        (lambda s: np.exp(-9e-5 * s), "delay", None),
    ],
)
def test_the_amplifier_by_its_shunt(law, verdict, order2):
    found = measured_source(shunts(law), load_bench(BENCH))
    assert found.verdict == verdict and found.settled
    assert found.name == (verdict if verdict == "amplifier_lag" else None)
    if found.name:
        tau, error = found.parameters["tau"]
        assert abs(tau - 9e-5) < 4 * error < 1e-6
    assert ("order2" in found.parameters) == (order2 is not None)
    if order2:
        assert abs(found.parameters["order2"][0] - order2) < 4 * found.parameters["order2"][1]


def test_a_shunt_in_some_recordings_only_is_told():
    made = shunts(lambda s: 1 / (1 + 9e-5 * s))
    bare = on_command(made)
    assert has_shunt(made[0]) and not has_shunt(bare[0])
    assert np.array_equal(bare[0].channels["current"], made[0].channels["command"])
    assert measured_source(bare, load_bench(BENCH)) is None and known_instruments(bare, (), load_bench(BENCH)) == ()
    with pytest.raises(RecordingError, match="no measured current beside the command"):
        measured_source([made[0], bare[1]], load_bench(BENCH))


def calibration(law, frequencies=(20, 100, 400, 900)):
    return [passed(law, f, "reference", "displacement", 2e-5, 4e-8) for f in frequencies]


def test_the_sensor_by_its_calibration():
    bench, (tau, order2) = load_bench(BENCH), mode_as_filter(400.0, 1 / np.sqrt(2))
    assert order2 == pytest.approx(0.5) and filter_as_mode(tau, order2) == pytest.approx((400.0, 1 / np.sqrt(2)))
    found = measured_sensor(calibration(lambda s: 1 / (1 + tau * s + 0.5 * (tau * s) ** 2)), bench)
    assert found.name == "sensor_lag" and "second-order filter of 400 Hz, damping 0.71" in found.text
    assert all(abs(v - t) < 4 * e for (v, e), t in zip(found.parameters.values(), (tau, 0.5), strict=True))
    effect = found.effect()
    assert float(effect.tau) == found.parameters["tau"][0]
    late = measured_sensor(calibration(lambda s: np.exp(-3e-4 * s)), bench)
    assert late.name == "transport_delay" and abs(late.parameters["tau"][0] / 3e-4 - 1) < 1e-3
    fine = measured_sensor(calibration(lambda s: 0.9 + 0 * s), bench)
    assert fine.verdict == "follows" and fine.settled and "scale is 0.9" in fine.text
    strange = measured_sensor(calibration(lambda s: 1 / (1 + 3e-4 * s) ** 4), bench)
    assert strange.verdict == "unknown" and not strange.settled and strange.effect() is None
    assert measured_sensor([], bench) is None
    with pytest.raises(RecordingError, match="three or more"):
        measured_sensor(calibration(lambda s: 1 + 0 * s, (20, 50)), bench)


def test_calibrations_and_shunts_are_read_from_files(tmp_path):
    made = calibration(lambda s: 1 / (1 + 3e-4 * s), (50, 100, 200))
    for k, r in enumerate(made):
        write_recording(tmp_path / f"c{k}.csv", r)
    read = load_calibrations(sorted(tmp_path.glob("c*.csv")), BENCH)
    assert read[1].drive == "reference" and read[1].frequency() == pytest.approx(100)
    assert measured_sensor(read, load_bench(BENCH)).parameters["tau"][0] == pytest.approx(3e-4, rel=1e-3)
    run = shunts(lambda s: 1 / (1 + 9e-5 * s), (50,))[0]
    write_recording(tmp_path / "run.csv", run)
    (again,) = load_recordings([tmp_path / "run.csv"], BENCH)
    assert again.drive == "current" and has_shunt(again) and np.allclose(again.channels["command"], run.channels["command"])
    with pytest.raises(RecordingError, match="no reference column .* name it reference_m"):
        load_calibrations([tmp_path / "run.csv"], BENCH)


def test_a_bench_file_states_the_sensors_filter(tmp_path):
    text = "[coil]\nN_m = 1300\nA_m = 2.8e-5\nc0 = 1.5e4\nH_bias = 1.2e4\nR_eddy = 70\n[magnetostriction]\nlambda_s = 1e-3\nM_s = 7e5\nl_rod = 0.05\n"
    text += "[mechanics]\nf0 = 392\nxi = 0.8\n"
    path = tmp_path / "bench.toml"
    path.write_text(text + "[sensor]\ntau = 5.6e-4\norder2 = 0.5\n")
    bench = load_bench(path)
    (effect,) = bench.actuator().effects
    assert effect.name == "sensor_lag" and float(effect.order2) == 0.5
    assert bench.priors == {"effects.sensor_lag.tau": pytest.approx(5.6e-7), "effects.sensor_lag.order2": 1e-3}
    path.write_text(text + "[sensor]\norder2 = 0.5\n")
    with pytest.raises(ConfigurationError, match="order2 without sensor.tau"):
        load_bench(path)


def fitted(f0, xi, tau, order2, effects=("sensor_lag",)):
    values = {"mechanics.f0": f0, "mechanics.xi": xi, "effects.sensor_lag.tau": tau, "effects.sensor_lag.order2": order2}
    rows = [SimpleNamespace(name=n, value=v, free=True) for n, v in values.items()]
    actuator = SimpleNamespace(effects=[SimpleNamespace(name=n) for n in effects])
    return SimpleNamespace(actuator=actuator, estimates=rows, estimate=lambda name: next(r for r in rows if r.name == name))


def test_a_filter_that_could_change_places_with_the_rod_is_told():
    bench = load_bench(BENCH)
    text, ringing = exchange(fitted(400.0, 0.71, *mode_as_filter(2000.0, 0.1)), bench)
    assert ringing and "2000 Hz, damping 0.1" in text and "400 Hz, damping 0.71" in text and "not told apart" in text
    text, ringing = exchange(fitted(2000.0, 0.1, *mode_as_filter(400.0, 0.71)), bench)
    assert not ringing and "right way round" in text
    assert exchange(fitted(405.0, 0.8, 1e-4, 0.0), bench) is None  # of first order: nothing to exchange
    assert exchange(fitted(405.0, 0.8, 1e-4, 0.5, ("sensor_lag", "delta_e")), bench) is None
    bent = fitted(405.0, 0.8, 1e-4, 1.4, ("sensor_lag", "sensor_nonlinearity"))
    assert exchange(bent, bench) is None and exchange(bent, bench, form="sensor_nonlinearity")[1]  # that one only mends a form
    known = dataclasses.replace(bench, priors={"mechanics.f0": 20.0})
    assert exchange(fitted(405.0, 0.8, 1e-4, 0.5), known) is None
