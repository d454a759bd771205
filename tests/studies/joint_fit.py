"""`python -m tests.studies.joint_fit`: does the fit's stated error mean what it says, on benches of the independent generator?

Forty draws: four densities, ten noises each, demagnetized start, 16-bit counts, noise on the current; and the paper's form,
one unknown a cell (L = 25), on twelve loops with 0.5 % noise at five seeds, starts 40 % off, of a bench with 325 masses and of one
with a finer density. Results in joint_fit.json.
"""

import dataclasses
import json
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
import numpy as np  # noqa: E402

from fitting.check import check_errors  # noqa: E402
from fitting.fit import fit  # noqa: E402
from fitting.joint import data_jacobian, prior_matrix  # noqa: E402
from fitting.setup import Choices  # noqa: E402
from fitting.uncertainty import covariance  # noqa: E402
from magjax.bench import load_bench  # noqa: E402
from magjax.recording import Recording  # noqa: E402
from tests.blind.generator.bench import ConcealedBench  # noqa: E402

TRUTH = {"R_eddy": 62.0, "f0": 405.0, "xi": 0.81, "H_bias": 1.23e4}
NAMES = {"coil.R_eddy": "R_eddy", "mechanics.f0": "f0", "mechanics.xi": "xi"}
SINES = [
    (10, 0.8, 0.1),
    (25, 0.4, -0.2),
    (50, 0.8, 0.0),
    (80, 0.4, 0.3),
    (120, 0.8, 0.1),
    (160, 0.4, 0.0),
    (200, 0.8, -0.05),
    (250, 0.4, 0.2),
    (300, 0.8, 0.1),
]
CHECK = (  # another frequency, a multisine, a modulated sine
    {"frequency": 400.0, "amplitude": 0.6, "offset": 0.05},
    {"frequency": 20.0, "amplitude": 0.45, "offset": 0.05, "extra": ((2, 0.3, 1.0), (5, 0.25, 2.0))},
    {"frequency": 15.0, "amplitude": 0.35, "offset": 0.05, "silent": True, "extra": ((5, 0.4, 0.0), (6, 1.0, 0.0), (7, 0.4, 0.0))},
)
EVERYTHING = tuple({"frequency": f, "amplitude": A, "offset": b} for f, A, b in SINES) + CHECK
H_BIAS_PRIOR = 300.0  # A/m; the bench's H_bias is off by as much, either way


def noisy(y, current, frequency, rng, noise, name):
    """A recording with white noise, 16-bit counts and noise on the current."""
    n = len(y)
    time = np.arange(n) * 4 / (frequency * n)
    counts = 2e-4 / 2**16
    reading = np.round((y + noise * rng.standard_normal(n)) / counts) * counts
    return Recording(time, {"current": current + 5e-4 * rng.standard_normal(n), "displacement": reading}, {}, {}, name)


def settled(density):
    """Current and reading of every drive on a bench of this density: four settled periods each."""
    made = ConcealedBench(TRUTH, {}, density, "demagnetized", np.random.default_rng(5))
    signals = made.run(EVERYTHING, steps=500)
    return [np.tile(signals[name], (1, 4)) for name in ("current", "reading")]


def one_draw(signals, draw):
    """Recordings with their noise, those of CHECK last, and a start: each constant up to 40 % off."""
    rng = np.random.default_rng(1000 + draw)
    rows = zip(*signals, EVERYTHING, strict=True)
    recordings = [noisy(y, current, d["frequency"], rng, 41e-9, str(k)) for k, (current, y, d) in enumerate(rows)]
    return recordings, {name: TRUTH[short] * rng.uniform(0.6, 1.4) for name, short in NAMES.items()}


def draws(numbers=10, densities=("gauss", "lobes", "heavy", "rough")):
    """chi2/N, pulls of the constants and check errors over their noise for every draw."""
    rows = []
    bench = load_bench("aa-050h")
    for density in densities:
        signals = settled(density)
        for draw in range(numbers):
            recordings, start = one_draw(signals, draw)
            found = fit(recordings[: len(SINES)], bench, actuator=bench.actuator().replace(start))
            pulls = {v: (found.estimate(k).value - TRUTH[v]) / found.estimate(k).stderr for k, v in NAMES.items()}
            off = {v: found.estimate(k).value / TRUTH[v] - 1 for k, v in NAMES.items()}
            check = [
                r["rms_after"] / r["noise_rms"]
                for r in check_errors(found.actuator, found.actuator, recordings[len(SINES) :], bench)
            ]
            rows.append(
                {
                    "density": density,
                    "draw": draw,
                    "chi2n": found.chi2_per_sample,
                    "pulls": pulls,
                    "relative": off,
                    "check": check,
                    "seconds": found.solve_s,
                }
            )
            print(
                density,
                draw,
                round(found.chi2_per_sample, 3),
                {k: round(float(v), 2) for k, v in pulls.items()},
                np.round(check, 2),
                round(found.solve_s, 1),
                flush=True,
            )
    return rows


def paper_form(bench):
    """The demo's concealed bench with 325 masses, a smooth density on the plane that the loops of `cells` reach."""
    from fitting.demo import concealed_actuator
    from magjax.preisach import Preisach, density_masses

    def density(s, r):
        return np.exp(-0.5 * (np.log(np.maximum(r, 1e-9) / 1500) / 0.6) ** 2) / np.maximum(r, 1.0) * (1 + (s / 9000) ** 2) ** -2

    true = concealed_actuator(bench)
    low, high = (1.23e4 + 1.54e4 * (0.1 + 0.8 * c) for c in (-1.02, 1.02))
    M_s = float(true.magnetostriction.M_s)
    return dataclasses.replace(true, hysteresis=Preisach(density_masses(density, 25, low, high, 0.33 * M_s), low, high, 0.57 * M_s))


def cells(form: str, seeds=5):
    """One unknown a cell: 325 masses with R_eddy, xi, f0 and H_bias (prior of 300 A/m, started 300 A/m off) on 12 loops of 500 samples with 0.5 % noise.

    `form` of the bench's density: "paper", 325 masses as well, or "finer", 12,880, which no 325 can hold.
    """
    from fitting.demo import concealed_actuator
    from magjax.simulate import simulate

    bench = load_bench("aa-050h")
    true = paper_form(bench) if form == "paper" else concealed_actuator(bench)
    rows = []
    loops = [(f, A, b) for f in (10, 30, 80, 150, 220, 300) for A, b in ((0.8, 0.1), (0.45, -0.1))]
    readings = []
    for f, A, b in loops:
        current = b + A * np.sin(2 * np.pi * np.arange(500) / 500)
        readings.append((current, np.asarray(simulate(true, current, 1 / (f * 500), periodic=True).reading)))
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        recordings = []
        for (f, _, _), (current, y) in zip(loops, readings, strict=True):
            noise = 0.005 * np.ptp(y)
            recordings.append(
                Recording(
                    np.arange(500) / (f * 500),
                    {"current": current, "displacement": y + noise * rng.standard_normal(500)},
                    {"displacement": noise},
                    {},
                    f"{f} Hz",
                )
            )
        off = {"coil.R_eddy": 62 * 1.4, "mechanics.xi": 0.81 * 0.6, "mechanics.f0": 405 * 1.4}
        off["coil.H_bias"] = TRUTH["H_bias"] + H_BIAS_PRIOR * (-1) ** seed  # the prior is centred on it
        start = bench.actuator().replace(off)
        stated = dataclasses.replace(bench, priors={"coil.H_bias": H_BIAS_PRIOR})  # else a gauge against the density
        found = fit(recordings, stated, actuator=start, extra=("coil.H_bias",), choices=Choices(knots=None, level=25), refine=False)
        rows.append(
            {
                "form": form,
                "seed": seed,
                "chi2n": found.chi2_per_sample,
                **_errors(found),
                "jacobians": found.jacobians,
                "seconds": found.solve_s,
            }
        )
        print(rows[-1], flush=True)
    return rows


def _errors(found):
    """Relative errors of the quoted constants, what the fit states for them, and the bound of Cramer and Rao under the roughness
    that the data chose: all one standard deviation, relative."""
    true = {**{k: TRUTH[v] for k, v in NAMES.items()}, "coil.H_bias": TRUTH["H_bias"]}
    problem, z = found.problem, found.solution.z
    J = data_jacobian(problem, z)
    bound = covariance(J.T @ J + prior_matrix(problem, found.solution.weights), z, problem.layout)
    off, stated, least = {}, {}, {}
    for name, value in true.items():
        k = problem.layout.index(name)
        short = name.split(".")[1]
        off[short] = abs(found.estimate(name).value / value - 1)
        stated[short] = found.estimate(name).stderr / value
        least[short] = float(np.sqrt(bound[k, k]) * abs(problem.layout.slope(name, z)) / value)
    return {"relative": off, "stated": stated, "bound": least}


def main():
    """Run both (`cells` as argument: the second alone), print the summary, keep everything."""
    path = Path(__file__).with_name("joint_fit.json")
    cell_rows = cells("paper") + cells("finer")
    if "cells" in sys.argv[1:]:
        kept = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps({**kept, "cells": cell_rows}, indent=1) + "\n")
        return
    rows = draws()
    inside = {v: float(np.mean([abs(r["pulls"][v]) < 2 for r in rows])) for v in NAMES.values()}
    checks = np.array([r["check"] for r in rows])
    summary = {
        "draws": len(rows), "within two stated errors": inside, "chi2n_below_1.1": float(np.mean([r["chi2n"] < 1.1 for r in rows])),
        "largest_chi2n": max(r["chi2n"] for r in rows), "check_within_1.5_noise": float(np.mean(checks < 1.5)), "median_seconds": float(np.median([r["seconds"] for r in rows])),
        "largest_relative": {v: float(max(abs(r["relative"][v]) for r in rows)) for v in NAMES.values()},
    }  # fmt: skip
    print(json.dumps(summary, indent=1))
    path.write_text(json.dumps({"summary": summary, "cells": cell_rows, "draws": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
