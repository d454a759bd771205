"""`python -m tests.studies.riddle`: constants as strange as the founding paper's, and how the tool sees through them.

The bench, made by the independent generator (play operators, its own march of (4)): R_eddy = 290 ohm, f0 = 2 kHz, xi = 0.1,
an amplifier of 90 us and a Butterworth filter of 400 Hz in the sensor. First command and reading only; then the same drives
with a shunt, and the sensor moved by a known amount. Everything told is kept in riddle.json.
"""

import json
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
import numpy as np  # noqa: E402

from fitting.diagnose import diagnose  # noqa: E402
from fitting.setup import Choices  # noqa: E402
from magjax.bench import load_bench  # noqa: E402
from magjax.cli.runtime import prepare_jax  # noqa: E402
from magjax.recording import Recording  # noqa: E402
from tests.blind.generator.bench import command_of  # noqa: E402
from tests.blind.generator.coil import C0, FieldSolver  # noqa: E402
from tests.blind.generator.density import PlayDensity  # noqa: E402
from tests.blind.generator.rod import displacement, response  # noqa: E402
from tests.blind.generator.strain import M_S, free_displacement  # noqa: E402

TRUTH = {"coil.R_eddy": 290.0, "mechanics.f0": 2000.0, "mechanics.xi": 0.1}
LAG, CORNER = 90e-6, 400.0  # s of the amplifier, Hz of the sensor's filter
BUTTERWORTH = (np.sqrt(2) / (2 * np.pi * CORNER), 0.5)  # tau, order2
SINES = ((10, 0.8, 0.1), (20, 0.5, -0.2), (50, 0.8, 0.1), (100, 0.5, -0.2), (200, 0.8, 0.1), (300, 0.5, 0.0))
CHECKS = ((400, 0.8, 0.1), (65, 0.5, -0.2))  # loops that were fitted, at other frequencies
SHAKER = (20, 60, 150, 300, 500, 800, 1200)  # Hz of the calibration
NOISE, SHUNT_NOISE, REFERENCE_NOISE = 41e-9, 2e-4, 5e-9  # m, A, m
STEPS, PERIODS = 1000, 4
KEPT = Path(__file__).with_name("riddle.json")


def butterworth(s):
    """The sensor's filter."""
    w = 2 * np.pi * CORNER
    return w**2 / (s * s + np.sqrt(2) * w * s + w**2)


def settled(density: str = "gauss", seed: int = 5) -> dict:
    """One settled period of every drive: command, current (A), reading (m), each (drives, steps), and the frequencies."""
    drives = [{"frequency": f, "amplitude": A, "offset": b} for f, A, b in (*SINES, *CHECKS)]
    frequency = np.array([float(d["frequency"]) for d in drives])
    command = np.array([command_of(d, STEPS) for d in drives])
    current = response(command, frequency, lambda s: 1 / (1 + s * LAG))
    plays = PlayDensity(density, 0.92 * M_S, np.random.default_rng(seed))
    applied = 1.23e4 + C0 * current
    M, H = FieldSolver(plays, TRUTH["coil.R_eddy"], {}).solve(applied, 1 / (frequency * STEPS), "demagnetized", settle=6)
    rod = {"f0": TRUTH["mechanics.f0"], "xi": TRUTH["mechanics.xi"]}
    y = displacement(free_displacement(M, H, {}), M, frequency, rod, {})
    return {"frequency": frequency, "command": command, "current": current, "reading": response(y, frequency, butterworth)}


def recordings(signals: dict, shunt: bool, seed: int = 1) -> tuple[list, list]:
    """(for the fit, to check): four periods each; without `shunt` the current is the command."""
    rng = np.random.default_rng(seed)
    rows = []
    for k, f in enumerate(signals["frequency"]):
        command, current, y = (np.tile(signals[c][k], PERIODS) for c in ("command", "current", "reading"))
        count = 2e-4 / 2**16
        channels = {"displacement": np.round((y + NOISE * rng.standard_normal(len(y))) / count) * count}
        if shunt:
            channels |= {"command": command, "current": current + SHUNT_NOISE * rng.standard_normal(len(y))}
        else:
            channels |= {"current": command}
        name = f"{'shunt' if shunt else 'plain'}_{f:g}Hz"
        rows.append(Recording(np.arange(len(y)) / (f * STEPS), channels, {}, {}, name))
    return rows[: len(SINES)], rows[len(SINES) :]


def calibrations(seed: int = 2) -> list:
    """The sensor on a shaker, 20 um at seven frequencies, beside a reference that is known better."""
    rng = np.random.default_rng(seed)
    rows = []
    for f in SHAKER:
        x = np.tile(2e-5 * np.sin(2 * np.pi * np.arange(STEPS) / STEPS), PERIODS)
        y = response(x[None], np.array([f / PERIODS]), butterworth)[0]
        channels = {
            "reference": x + REFERENCE_NOISE * rng.standard_normal(len(x)),
            "displacement": y + NOISE * rng.standard_normal(len(x)),
        }
        rows.append(Recording(np.arange(len(x)) / (f * STEPS), channels, {}, {}, f"shaker_{f}Hz"))
    return rows


def constants(result) -> dict:
    """name -> [value, standard error] of what the riddle is about."""
    return {n: [result.estimate(n).value, result.estimate(n).stderr] for n in TRUTH}


def part(found, seconds: float) -> dict:
    """What is kept of a diagnosis."""
    content = found.as_dict()
    return {
        "verdict": found.verdict, "message": found.message, "effects": content["effects"], "groups": content["groups"],
        "next_experiment": content["next_experiment"], "check": content["check"], "chi2n_plain": found.base.chi2_per_sample,
        "chi2n_repaired": found.repaired.chi2_per_sample if found.repaired else None, "plain": constants(found.base),
        "repaired": constants(found.repaired) if found.repaired else None, "seconds": round(seconds, 1),
    }  # fmt: skip


ACTS = {"command and reading": False, "shunt and calibration": True}  # with the instruments' own recordings?


def act(instruments: bool, density: str = "gauss", choices: Choices | None = None, progress=None) -> dict:
    """One diagnosis: of command and reading alone, or with shunt and calibration."""
    runs, checks = recordings(settled(density), instruments)
    begin = time.perf_counter()
    found = diagnose(
        runs, load_bench("aa-050h"), check=checks, calibration=calibrations() if instruments else (),
        choices=choices or Choices(fine=250), progress=progress,
    )  # fmt: skip
    return part(found, time.perf_counter() - begin)


def pulls(told: dict) -> dict:
    """Distance of the repaired constants and of the instruments' from the truth, in stated errors."""
    found = {n: (v - TRUTH[n]) / e for n, (v, e) in told["repaired"].items()}
    true = {"amplifier_lag": {"tau": LAG}, "sensor_lag": dict(zip(("tau", "order2"), BUTTERWORTH, strict=True))}
    for effect in told["effects"]:
        for k, v in true.get(effect["name"], {}).items():
            row = effect["parameters"][k]
            found[f"{effect['name']}.{k}"] = float((row["value"] - v) / row["stderr"])
    return found


def tell(density: str = "gauss", acts=tuple(ACTS), choices: Choices | None = None, progress=None) -> dict:
    """The acts, and how far from the truth what the second one names is."""
    told = {"density": density, "truth": TRUTH | {"amplifier": LAG, "sensor": CORNER}}
    for name in acts:
        told[name] = act(ACTS[name], density, choices, progress)
        if ACTS[name]:
            told["pulls"] = pulls(told[name])
    return told


def main():
    """Tell it and keep it in riddle.json. `--act 1` or `2`: that one only, beside what is kept; `--density NAME`: only printed."""
    prepare_jax()
    options = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
    density = options.get("--density", "gauss")
    acts = [list(ACTS)[int(options["--act"]) - 1]] if "--act" in options else list(ACTS)
    begin = time.perf_counter()

    def progress(text, step, chi2):
        if step % 10 == 0:
            print(f"{time.perf_counter() - begin:7.1f} s  {text} {step or ''} {'' if chi2 is None else f'{chi2:.4g}'}", flush=True)

    told = tell(density, acts, progress=progress)
    for name in acts:
        print(f"\n{name}: {told[name]['verdict']}. {told[name]['message']}")
    print("\ndistance from the truth in stated errors:", {k: round(v, 2) for k, v in told.get("pulls", {}).items()})
    if density == "gauss":
        kept = json.loads(KEPT.read_text()) if len(acts) < len(ACTS) and KEPT.exists() else {}
        KEPT.write_text(json.dumps({**kept, **told}, indent=1) + "\n")


if __name__ == "__main__":
    main()
