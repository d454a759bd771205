"""How the parameters scatter when the recordings are drawn again: bootstrap of a fit.

Each draw is the fitted model's lines with new noise, refitted from the optimum with the roughness weights of the
quoted fit. The noise is drawn from the noise model ("parametric"), or the recordings' own periods are drawn with
replacement, in blocks of consecutive ones ("blocks": whatever the noise is, as far as the periods show it).
B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap (1993), ch. 6, 8 and 13; blocks: H. R. Kunsch, Ann. Stat. 17 (1989).
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from magjax.errors import ConfigurationError
from magjax.scale import Chunk, Job, run_job

from ..joint import data_residual
from .refit import BATCH, lean, settle, settle_each

CHUNK = BATCH  # draws that are done and kept together
KINDS = ("parametric", "blocks")
FEWEST_PERIODS = 3  # to draw blocks from


@dataclasses.dataclass(frozen=True)
class Bootstrap:
    """Draws of the free scalar parameters. `draws`: (draws, names), SI; `chi2`: per draw; `converged`: per draw.

    `estimate`: value that the fit quotes; `stderr`: what it states. `outcome`: how the job went.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimate: np.ndarray
    stderr: np.ndarray
    draws: np.ndarray
    chi2: np.ndarray
    converged: np.ndarray
    kind: str
    level: float
    seed: int
    outcome: object = dataclasses.field(repr=False, default=None)

    @property
    def kept(self) -> np.ndarray:
        """Draws that settled."""
        return self.draws[self.converged]

    def interval(self, name: str) -> tuple[float, float]:
        """Percentile interval of a parameter, SI."""
        tail = 50 * (1 - self.level)
        low, high = np.percentile(self.kept[:, self.names.index(name)], (tail, 100 - tail))
        return float(low), float(high)

    def deviation(self, name: str) -> float:
        """Standard deviation over the draws, SI."""
        return float(np.std(self.kept[:, self.names.index(name)], ddof=1))

    def as_dict(self) -> dict:
        """The entry "bootstrap" of fit.json."""
        rows = {}
        for k, name in enumerate(self.names):
            low, high = self.interval(name)
            rows[name] = {
                "low": low, "high": high, "mean": float(self.kept[:, k].mean()), "deviation": self.deviation(name),
                "estimate": float(self.estimate[k]), "stderr": float(self.stderr[k]), "unit": self.units[k],
            }  # fmt: skip
        return {
            "kind": self.kind, "draws": len(self.draws), "settled": int(self.converged.sum()), "level": self.level,
            "seed": self.seed,
            "parameters": rows,
        }  # fmt: skip

    def dataset(self):
        """The draws as an xarray Dataset."""
        import xarray as xr

        data = {n: ("draw", self.draws[:, k], {"units": self.units[k]}) for k, n in enumerate(self.names)}
        data |= {"chi2": ("draw", self.chi2), "settled": ("draw", self.converged.astype(np.int8))}
        return xr.Dataset(data, attrs={"kind": self.kind, "level": self.level, "seed": self.seed})

    def __str__(self):
        lines = [
            f"  bootstrap ({self.kind}), {len(self.draws)} draws, {int(self.converged.sum())} settled, "
            f"{100 * self.level:g} % intervals"
        ]
        for k, name in enumerate(self.names):
            low, high = self.interval(name)
            scatter = f"deviation {self.deviation(name):.2g} (stated {self.stderr[k]:.2g})"
            lines.append(f"  {name:32s} {low:12.6g} .. {high:<12.6g} {self.units[k]:10s} {scatter}")
        return "\n".join(lines)


def bootstrap_intervals(
    result,
    count: int = 200,
    *,
    kind: str = "parametric",
    level: float = 0.95,
    seed: int = 0,
    executor=None,
    checkpoint=None,
    progress=None,
) -> Bootstrap:
    """Bootstrap of a `FitResult`.

    `kind`: "parametric" or "blocks"; `level` of the percentile intervals; `executor`, `checkpoint`, `progress` as in
    `magjax.scale.run_job`. More draws with the same checkpoint go on from those that are there. Raises
    `ConfigurationError` where nothing scalar is free, or where a recording has too few periods for blocks.
    """
    problem = result.problem
    names = problem.layout.names
    if not names:
        raise ConfigurationError("the fit frees no scalar parameter; name some in [fit] free of the bench file")
    if count < 2 or not 0.5 <= level < 1 or kind not in KINDS:
        raise ConfigurationError(
            f'bootstrap of {count} draws, level {level}, "{kind}": '
            f"give 2 draws or more, a level of 0.5 to 1 and one of {', '.join(KINDS)}"
        )
    blocks = [period_lines(s, problem.target.lines.shape[1]) for s in problem.spectra] if kind == "blocks" else None
    weights = result.refined.weights
    centre = settle(lean(problem), result.refined.z, weights)
    inputs = {
        "problem": lean(problem), "z": centre.z, "weights": weights, "jacobian": centre.jacobian,
        "lines": model_lines(problem, centre.z), "blocks": blocks,
    }  # fmt: skip
    chunks = [Chunk(f"draws {k}-{min(k + CHUNK, count) - 1}", min(CHUNK, count - k)) for k in range(0, count, CHUNK)]
    outcome = run_job(
        Job(f"{kind} bootstrap", draw, inputs, tuple(chunks), seed), executor, checkpoint=checkpoint, progress=progress
    )
    values, chi2, converged = (np.concatenate([r[k] for r in outcome.results]) for k in ("values", "chi2", "converged"))
    if converged.sum() < 2:
        raise ConfigurationError(
            f"only {int(converged.sum())} of {count} refits settled; the fit itself has not: raise --max-jacobians"
        )
    rows = [result.estimate(n) for n in names]
    return Bootstrap(
        names, tuple(r.unit for r in rows), np.asarray([r.value for r in rows]), np.asarray([r.stderr for r in rows]),
        values, chi2, converged, kind, level, seed, outcome,
    )  # fmt: skip


def draw(inputs, count, rng):
    """A chunk of draws: parameters (draws, names), chi2 and whether each settled."""
    problem, blocks = inputs["problem"], inputs["blocks"]
    noise = [parametric_noise(problem.target, rng) if blocks is None else block_noise(blocks, rng) for _ in range(count)]
    found = settle_each(problem, inputs["lines"] + np.asarray(noise), inputs["z"], inputs["weights"], inputs["jacobian"])
    z = jnp.asarray(np.stack([s.z for s in found]).T)
    values = np.stack([np.asarray(problem.layout.value(n, z)) for n in problem.layout.names], axis=1)
    return {"values": values, "chi2": np.asarray([s.chi2 for s in found]), "converged": np.asarray([s.converged for s in found])}


def coloured(target, white):
    """Whitened complex misfit (recordings, harmonics + 1) -> lines: the inverse of `whitened`, zero where nothing is measured."""
    rows, deviations = np.asarray(target.gain_rows), np.asarray(target.deviations)
    shares = np.asarray(target.gain_shares)
    identity = np.eye(len(rows))
    along = np.sum((np.conj(rows) * white).real, axis=1)
    misfit = white + ((np.linalg.inv(identity - shares) - identity) @ along)[:, None] * rows
    return np.where(np.isfinite(deviations), np.where(np.isfinite(deviations), deviations, 0.0) * misfit, 0.0)


def model_lines(problem, z):
    """The model's lines at z, from the whitened misfit; the measured ones where a line does not count."""
    residual = data_residual(problem, z)
    R, H = problem.target.lines.shape
    white = residual[: R * H].reshape(R, H).astype(complex)
    white[:, 1:] += 1j * residual[R * H :].reshape(R, H - 1)
    return np.asarray(problem.target.lines) + coloured(problem.target, white)


def parametric_noise(target, rng):
    """Noise of the lines as the fit takes it to be: white and flicker, converters, uncertain scales."""
    shape = target.lines.shape
    white = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    white[:, 0] = white[:, 0].real
    return coloured(target, white)


def period_lines(spectrum, count: int):
    """How each period's lines differ from their mean, (periods, count) complex, widened for what drawing in blocks loses.

    Circular blocks of b out of P periods give a mean whose variance is short by 1 - b/P. Raises `ConfigurationError`
    below three periods.
    """
    periods, samples = spectrum.periods, spectrum.samples
    if periods < FEWEST_PERIODS:
        raise ConfigurationError(
            f"{spectrum.name}: {periods} period{'s' if periods > 1 else ''} cannot be drawn in blocks ({FEWEST_PERIODS} or more); "
            "use the parametric bootstrap"
        )
    phases = np.arange(samples) * (periods / samples)
    lines = np.zeros((periods, count), complex)
    for p in range(periods):
        inside = (phases >= p) & (phases < p + 1)
        lines[p] = np.exp(-2j * np.pi * np.outer(np.arange(count), phases[inside])) @ spectrum.residue[inside] / inside.sum()
    return (lines - lines.mean(axis=0)) * np.sqrt(periods / (periods - block_length(periods)))


def block_length(periods: int) -> int:
    """Consecutive periods that are drawn together: about the cube root of their number."""
    return 1 if periods < 8 else round(periods ** (1 / 3))


def block_noise(blocks, rng):
    """Noise of the mean over periods drawn with replacement, in circular blocks."""
    noise = []
    for lines in blocks:
        periods = len(lines)
        length = block_length(periods)
        starts = rng.integers(periods, size=-(-periods // length))
        chosen = ((starts[:, None] + np.arange(length)) % periods).ravel()[:periods]
        mean = lines[chosen].mean(axis=0)
        mean[0] = mean[0].real
        noise.append(mean)
    return np.stack(noise)
