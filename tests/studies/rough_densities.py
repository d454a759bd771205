"""`python -m tests.studies.rough_densities`: what densities with steps leave of a fit, and how drives that took no part are foretold.

Ten benches of the independent generator with nothing concealed, whose densities no hats follow: random cells, patches of 40 and of
300 Voronoi points, blocks, leaning ridges, two of each; nine sines, 41 nm of noise, constants started up to 40 % off. Each is fitted
under one roughness weight a family of differences alone and where these may have weights of their own (`fitting.steps`). Results in
rough_densities.json.
"""

import json
from pathlib import Path
from unittest import mock

import jax

jax.config.update("jax_enable_x64", True)
import numpy as np  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from fitting.check import check_errors  # noqa: E402
from fitting.fit import fit  # noqa: E402
from magjax.bench import load_bench  # noqa: E402
from tests.blind.generator.bench import ConcealedBench  # noqa: E402
from tests.blind.generator.density import SHAPES  # noqa: E402
from tests.studies.joint_fit import EVERYTHING, NAMES, SINES, TRUTH, one_draw  # noqa: E402

NEVER = (10**6, 10**6)  # knots that no hats have
KINDS = ("cells", "patches of 40", "patches of 300", "blocks", "ridges")


def patches(number):
    """Shares of Voronoi cells about so many random points, over the smooth density of `gauss`; u, v: scaled mean and half-width."""

    def shape(u, v, rng):
        points = np.stack([rng.uniform(-0.8, 0.8, number), rng.uniform(0, 0.35, number)], axis=1)
        nearest = cKDTree(points).query(np.stack([u.ravel(), v.ravel()], axis=1))[1]
        return rng.lognormal(0, 0.5, number)[nearest].reshape(u.shape) * SHAPES["gauss"](u, v, rng)

    return shape


def blocks(u, v, rng):
    """Eight to fifteen steps along either axis, finer where relays are narrow."""
    rows, columns = rng.integers(8, 16, 2)
    row = np.clip(((u + 0.9) / 1.8 * rows).astype(int), 0, rows - 1)
    column = np.clip((np.sqrt(v / 0.5) * columns).astype(int), 0, columns - 1)
    return rng.lognormal(0, 0.6, (rows, columns))[row, column] * SHAPES["gauss"](u, v, rng)


def ridges(u, v, rng):
    """Ridges that lean, four times as high as what is between them."""
    lean, wave, shift = rng.uniform(-1.2, 1.2), rng.uniform(20, 60), rng.uniform(0, 6.3)
    return (0.35 + (np.sin(wave * (u + lean * v) + shift) > 0.3)) * SHAPES["mixture"](u, v, rng)


def settled(kind, seed):
    """Current and reading of every drive: four settled periods each."""
    shapes = {"patches of 40": patches(40), "patches of 300": patches(300), "blocks": blocks, "ridges": ridges}
    with mock.patch.dict(SHAPES, shapes):
        made = ConcealedBench(TRUTH, {}, kind, "demagnetized", np.random.default_rng(seed))
    signals = made.run(EVERYTHING, steps=500)
    return [np.tile(signals[name], (1, 4)) for name in ("current", "reading")]


def fitted(recordings, start, bench) -> dict:
    """chi2/N, pulls of the constants, errors on check recordings in units of their noise."""
    found = fit(recordings[: len(SINES)], bench, actuator=bench.actuator().replace(start), refine=100.0)
    checks = check_errors(found.actuator, found.actuator, recordings[len(SINES) :], bench)
    return {
        "density": list(found.choices.knots or (found.choices.cells,)),
        "steps": found.choices.stiffness is not None,
        "chi2n": found.chi2_per_sample,
        "pulls": {v: (found.estimate(k).value - TRUTH[v]) / found.estimate(k).stderr for k, v in NAMES.items()},
        "check": [row["rms_after"] / row["noise_rms"] for row in checks],
    }


def main():
    """Every bench both ways, printed as they come."""
    bench, rows = load_bench("aa-050h"), []
    for kind in KINDS:
        for seed in (1, 2):
            recordings, start = one_draw(settled(kind, seed), seed)
            with mock.patch("fitting.finer.STEPS_ON", NEVER):
                even = fitted(recordings, start, bench)
            rows.append({"kind": kind, "seed": seed, "even": even, "own": fitted(recordings, start, bench)})
            for way in ("even", "own"):
                found = rows[-1][way]
                print(f"{kind} {seed} {way:4s} {found['density']} {found['chi2n']:.2f} checks", np.round(found["check"], 2), flush=True)
    summary = {}
    for way in ("even", "own"):
        checks = np.concatenate([row[way]["check"] for row in rows])
        pulls = np.abs([list(row[way]["pulls"].values()) for row in rows])
        summary[way] = {
            "chi2n_median": float(np.median([row[way]["chi2n"] for row in rows])),
            "chi2n_highest": max(row[way]["chi2n"] for row in rows),
            "check_median": float(np.median(checks)),
            "check_nine_tenths": float(np.quantile(checks, 0.9)),
            "within_two_errors": float(np.mean(pulls < 2)),
        }
        print(way, {k: round(v, 2) for k, v in summary[way].items()})
    Path(__file__).with_suffix(".json").write_text(json.dumps({"summary": summary, "benches": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
