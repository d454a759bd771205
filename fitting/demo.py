"""The whole story without a bench: an actuator with a concealed effect, recorded with noise, fitted, diagnosed."""

import dataclasses
import json

import numpy as np

from magjax.bench import load_bench
from magjax.effects.excess_loss import ExcessLoss
from magjax.preisach import Preisach, density_masses
from magjax.recording import Recording
from magjax.simulate import simulate
from magjax.writers import write_recording

from .diagnose import diagnose
from .fit import fit

SINES = ((10, 0.8, 0.1), (20, 0.5, -0.2), (50, 0.8, 0.1), (100, 0.5, -0.2), (200, 0.8, 0.1), (300, 0.5, 0.0))
TRUTH = {"coil.R_eddy": 62.0, "mechanics.xi": 0.81, "mechanics.f0": 405.0}
NOISE = 40e-9  # m rms
SAMPLES, PERIODS = 1000, 4


def concealed_actuator(bench, effect=None, rough: bool = False):
    """The bench's actuator with other constants, a density of another form on a finer plane, and a hidden effect.

    `rough`: a density with a 40 % ripple and a second lobe, which does not factorise.
    """
    actuator = bench.actuator().replace(TRUTH)

    def density(s, r):
        lognormal = np.exp(-0.5 * (np.log(np.maximum(r, 1e-9) / 1500) / 0.6) ** 2) / np.maximum(r, 1.0)
        value = lognormal * (1 + (s / 9000) ** 2) ** -2 + 1e-7 * np.exp(-((s / 9000) ** 2))
        if not rough:
            return value
        ripple = 1 + 0.4 * np.sin(s / 900 + r / 400) * np.cos(r / 300 - s / 2100)
        return value * ripple + 3e-5 * np.exp(-(((s - 6000) / 2500) ** 2) - ((r - 2500) / 700) ** 2)

    low, high = -2.0e3, 2.75e4
    masses = density_masses(density, 160, low, high, 0.33 * float(actuator.magnetostriction.M_s), refine=4)
    actuator = dataclasses.replace(actuator, hysteresis=Preisach(masses, low, high, 0.57 * float(actuator.magnetostriction.M_s)))
    return actuator if effect is None else actuator.with_effect(effect)


def record(actuator, frequency, amplitude, offset, rng, name) -> Recording:
    """Four settled periods with white noise and 16-bit counts."""
    phase = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    current = offset + amplitude * np.sin(phase)
    dt = 1 / (frequency * SAMPLES)
    reading = np.tile(np.asarray(simulate(actuator, current, dt, periodic=True).reading), PERIODS)
    reading = reading + NOISE * rng.standard_normal(reading.size)
    count = 100e-6 / 2**16
    time = dt * np.arange(reading.size)
    channels = {"current": np.tile(current, PERIODS), "displacement": np.round(reading / count) * count}
    return Recording(time, channels, {}, {"file": name, "metadata": {"frequency_Hz": frequency, "current": "measured"}}, name)


def run_demo(folder, seed: int = 0, progress=None):
    """Write recordings, fit.json, diagnosis.json and the reports; return (text, content)."""
    from .report import write_diagnosis, write_fit

    rng = np.random.default_rng(seed)
    bench = load_bench("aa-050h")
    hidden = ExcessLoss(k=25.0, rate_knee=5.0)
    truth = concealed_actuator(bench, hidden)
    recordings = [record(truth, *drive, rng, f"rec_{drive[0]:03d}Hz.csv") for drive in SINES]
    checks = [record(truth, 400, 0.6, 0.05, rng, "check_400Hz.csv"), record(truth, 150, 0.7, 0.0, rng, "check_150Hz.csv")]
    for recording in (*recordings, *checks):
        write_recording(folder / recording.name, recording)
    plain = fit(recordings, bench, progress=progress)
    found = diagnose(recordings, bench, check=checks, progress=progress)
    for part in ("fit", "diagnosis"):
        (folder / part).mkdir(exist_ok=True)
    write_fit(folder / "fit", plain, recordings, plain.as_dict(), f"magjax demo --seed {seed}", progress)
    write_diagnosis(folder / "diagnosis", found, recordings, found.as_dict(), f"magjax demo --seed {seed}", checks, progress)
    content = {"truth": TRUTH | {"effects.excess_loss.k": 25.0}, "fit": plain.as_dict(), "diagnosis": found.as_dict()}
    (folder / "truth.json").write_text(json.dumps(content["truth"]))
    return _story(plain, found, folder), content


def _story(plain, found, folder) -> str:
    rows = ["A bench was invented: other constants than its file says, and an excess loss that the plain model lacks.", ""]
    rows.append(f"plain fit: {plain.message}")
    rows.append(f"diagnosis: {found.message}")
    rows += ["", f"  {'parameter':28s} {'true':>10s} {'plain fit':>12s} {'repaired':>12s} {'stderr':>9s}"]
    fixed = found.repaired
    for name, true in {**TRUTH, "effects.excess_loss.k": 25.0}.items():
        before = f"{plain.estimate(name).value:12.5g}" if not name.startswith("effects") else " " * 12
        after = next((e for e in fixed.estimates if e.name == name), None) if fixed else None
        rows.append(
            f"  {name:28s} {true:10.5g} {before} " + (f"{after.value:12.5g} {after.stderr:9.2g}" if after else "           -")
        )
    rows += ["", f"recordings and reports are in {folder} (open {folder}/diagnosis/report.html)"]
    return "\n".join(rows)


def tracking_benches(bench, hidden, parameters, seed: int = 0, progress=None):
    """A bench with `hidden` concealed, recorded, fitted and diagnosed, for tracking studies.

    Returns the models before and after the diagnosis and the plant itself as `magjax.inverse.PlainActuator`, and the
    diagnosis as a dict with its verdict and message.
    """
    from magjax.effects import CLASSES
    from magjax.inverse import PlainActuator

    bench = load_bench(bench)
    effect = CLASSES[hidden](**parameters)
    true = concealed_actuator(bench, effect)
    rng = np.random.default_rng(seed)
    sines = [*SINES, (100, 0.8, 0.0), (200, 0.4, -0.3), (30, 0.85, 0.0)]
    recordings = [record(true, f, A, b, rng, f"sine {f} Hz, {A} A") for f, A, b in sines]
    found = diagnose(recordings, bench, progress=progress)
    repaired = (found.repaired or found.base).actuator
    models = [PlainActuator.from_actuator(a) for a in (found.base.actuator, repaired, true)]
    return (*models, {"verdict": found.verdict, "message": found.message})
