"""What an oracle that knows the law and the bench could see: `python -m tests.blind.oracle test [--rivals]` adds to ORACLE.json, or RIVALS.json.

The oracle's z of a concealed effect is the length of its noise-free trace d after everything that the base model could take up:
    z^2 = d' (sigma^2 I + A P A')^-1 d,
A the tangent of the base at the truth (R_eddy, f0, xi, an offset of M, the density on hats in mean and coercive field, a mechanical
transient a recording), P a wide prior on each. Tangents of the density are taken with the plays frozen: dH + K dB/dt = 0 with
dM = D(t) + g(t) dH, D the hat's own magnetization and g = dM/dH.

What the oracle sees of a single effect beyond its nearest rival is z sqrt(1 - c^2), c the cosine of the two traces in that metric, the rival's
law and sizes known but for its amplitude. Where that is small the two cannot be told apart; a rival with shapes of its own may come nearer.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from .cases import SUITES, Case, bench_of, make_case, size
from .generator.coil import AREA, C0, MU0, TURNS
from .generator.instruments import PERIODS
from .generator.rod import response
from .generator.sensor import beside
from .generator.strain import FULL, M_S
from .strengths import VISIBLE

FILE = Path(__file__).with_name("ORACLE.json")
RIVALS = Path(__file__).with_name("RIVALS.json")
STEPS = 250
MEAN_KNOTS = np.linspace(-2.4e4, 3.2e4, 17)
COERCIVE_KNOTS = 1.6e4 * (np.arange(13) / 12) ** 1.6


class Sight:
    """The base bench of a case and its tangent: `columns` (numbers, parameters) with prior widths folded in, m."""

    def __init__(self, case: Case):
        self.case, self.drives = case, list(case.drives)
        self.bench = bench_of(case).without()
        self.frequency = np.array([d["frequency"] for d in self.drives])
        self.settled = self.bench.run(self.drives, steps=STEPS, settle=3)
        self.base = self.settled["reading"]
        # four periods of 250 means of the recorded samples
        samples = (
            case.instruments["rate"] / self.frequency
            if case.instruments["rate"]
            else np.full(len(self.drives), case.instruments["samples"])
        )
        sigma = np.hypot(case.instruments["noise"], case.instruments["pink"]) * np.sqrt(STEPS / samples)
        self.sigma = np.repeat(sigma, PERIODS * STEPS)
        self.columns = np.concatenate([self._parameters(), self._density(), self._transients()], axis=1) / self.sigma[:, None]

    def trace(self, effects):
        """What `effects` add to the readings, in standard deviations of the noise, (numbers,)."""
        bench = bench_of(self.case).without()
        bench.effects = dict(effects)
        with_it = bench.run(self.drives, steps=STEPS, settle=3)
        y = np.tile(with_it["reading"], (1, PERIODS // with_it["turns"])) - np.tile(self.base, (1, PERIODS))
        heat = np.mean(with_it["current"] ** 2, axis=1)
        rng = np.random.default_rng(self.case.seed + 3 * 10**6)
        time = np.arange(PERIODS * STEPS) / STEPS
        y += np.array([beside(time / f, q, effects, rng) for f, q in zip(self.frequency, heat, strict=True)])
        return y.ravel() / self.sigma

    def remove(self, x):
        """`x` less what the base takes up of it: (I + A A')^-1 x."""
        if not hasattr(self, "_solved"):
            A = self.columns
            self._solved = np.linalg.cholesky(A.T @ A + np.eye(A.shape[1]))
        A = self.columns
        half = np.linalg.solve(self._solved, A.T @ x)
        return x - A @ np.linalg.solve(self._solved.T, half)

    def z(self, trace) -> float:
        """Standard deviations by which a trace stands out."""
        return float(np.sqrt(max(trace @ self.remove(trace), 0.0)))

    def nearest_rival(self, name, size) -> tuple[str, float]:
        """The other effect, of middling size, that looks most like one of this size, and the z that is left of that beyond it."""
        own = self.trace({name: size})
        seen, left = self.remove(own), {}
        for rival, sizes in VISIBLE.items():
            if rival != name:
                other = self.trace({rival: sizes[1]})
                common = (other @ seen) ** 2 / max(other @ self.remove(other), 1e-30)
                left[rival] = float(np.sqrt(max(own @ seen - common, 0.0)))
        return min(left.items(), key=lambda row: row[1])

    def _tile(self, y):
        return np.tile(y, (1, PERIODS)).ravel()

    def _parameters(self):
        rows = []
        for name, width in (("R_eddy", 1.0), ("f0", 1.0), ("xi", 1.0)):
            shifted = bench_of(self.case).without()
            step = 1e-3 * self.case.truth[name]
            shifted.truth = {**self.case.truth, name: self.case.truth[name] + step}
            y = shifted.run(self.drives, steps=STEPS, settle=3)["reading"]
            rows.append(self._tile((y - self.base) / 1e-3 * width))
        return np.array(rows).T

    def _replay(self):
        """Plays (recordings, steps, radii) and dM/dH over the settled period."""
        density, H = self.bench.density, self.settled["H"]
        plays = density.start(H[:, 0].shape, self.bench.start)
        kept, slopes = [], []
        for turn in range(2):
            for n in range(STEPS):
                plays, _, slope = density.evaluate(plays, H[:, n])
                if turn:
                    kept.append(plays)
                    slopes.append(slope)
        return np.stack(kept, axis=1), np.stack(slopes, axis=1)

    def _density(self):
        plays, slope = self._replay()
        radii = self.bench.density.radii
        hats_r = np.maximum(0, 1 - np.abs(_place(radii, COERCIVE_KNOTS)[:, None] - np.arange(len(COERCIVE_KNOTS))))
        hats_r *= np.gradient(radii)[:, None]
        hats_r /= np.maximum(hats_r.sum(axis=0), 1e-9)
        place = _place(plays, MEAN_KNOTS)
        D = np.stack([np.clip(place - k, -1, 1) @ hats_r for k in range(len(MEAN_KNOTS))], axis=-1)
        D = D.reshape(*D.shape[:2], -1)
        D = np.concatenate([D, np.ones_like(D[..., :1])], axis=-1) * 0.03 * M_S  # each hat may hold some per cent of M_s
        K = MU0 * C0 * TURNS * AREA / self.case.truth["R_eddy"]
        h = 1 / (self.frequency * STEPS)
        a = K / h
        dH = np.zeros_like(D[:, 0])
        out = np.empty_like(D)
        flux = D[:, -1]
        for _turn in range(3):
            for n in range(STEPS):
                gain = 1 + slope[:, n, None]
                dH = a[:, None] * (flux - D[:, n]) / (1 + a[:, None] * gain)
                flux = gain * dH + D[:, n]
                out[:, n] = flux - dH
        w, xi = 2 * np.pi * self.case.truth["f0"], self.case.truth["xi"]
        free = FULL * 2 * self.settled["M"][..., None] / M_S**2 * out
        columns = [
            self._tile(response(free[..., k], self.frequency, lambda s: 1 / (1 + 2 * xi * s / w + (s / w) ** 2)))
            for k in range(free.shape[-1])
        ]
        return np.array(columns).T

    def _transients(self):
        w, xi = 2 * np.pi * self.case.truth["f0"], self.case.truth["xi"]
        count = PERIODS * STEPS
        out = np.zeros((len(self.drives), count, 2 * len(self.drives)))
        for k, f in enumerate(self.frequency):
            time = np.arange(count) / (f * STEPS)
            for j, wave in enumerate((np.cos, np.sin)):
                out[k, :, 2 * k + j] = 1e-6 * np.exp(-xi * w * time) * wave(w * np.sqrt(abs(1 - xi**2)) * time)
        return out.reshape(len(self.drives) * count, -1)


def _place(x, knots):
    return np.interp(x, knots, np.arange(len(knots)))


def main():
    """z of every effect of every case of a suite, added to ORACLE.json; or what is left of single ones beyond the nearest rival."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--rivals", action="store_true")
    options = p.parse_args()
    file = RIVALS if options.rivals else FILE
    known = json.loads(file.read_text()) if file.exists() else {}
    for k in range(size(options.suite)):
        case = make_case(options.suite, k)
        if case.name in known or not case.effects or (options.rivals and case.kind != "single"):
            continue
        sight = Sight(case)
        if options.rivals:
            rival, left = sight.nearest_rival(*next(iter(case.effects.items())))
            known[case.name] = {rival: round(left, 1)}
        else:
            known[case.name] = {n: round(sight.z(sight.trace({n: s})), 1) for n, s in case.effects.items()}
        print(case.name, case.level, list(case.effects), known[case.name], flush=True)
        file.write_text(json.dumps(known, indent=0, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
