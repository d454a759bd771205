"""The result of a fit: a value that prints itself as a card and writes itself as JSON."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from magjax.errors import ConfigurationError

from .finer import in_words
from .uncertainty import visited_cells


@dataclasses.dataclass(frozen=True)
class RecordingFit:
    """How one recording was met; `frequency` of its drive, Hz; rms of what repeats, and noise of one sample, in the unit of its channel."""

    file: str
    sha256: str
    channel: str
    unit: str
    frequency: float
    periods: int
    noise_rms: float
    residual_rms: float
    chi2_per_sample: float


@dataclasses.dataclass(frozen=True)
class Quoted:
    """What a fit says of its parameters, and the solution that they are `refined` from, the fit's own where Ctrl-C stopped that."""

    refined: object
    estimates: tuple
    correlations: dict
    message: str
    interrupted: bool = False


@dataclasses.dataclass(frozen=True)
class FitResult:
    """A fitted actuator with what is known about it. `chi2_per_sample`: misfit per number of its harmonics (`data_count`) over
    their noise; `unknowns`: as many as the data settle; `compile_s`, `solve_s`: s.

    `quote` makes the `Quoted`: most fits of a diagnosis are never asked for theirs, which take Jacobians of their own.
    """

    actuator: object
    bench: object
    converged: bool
    recordings: tuple[RecordingFit, ...]
    chi2_per_sample: float
    data_count: int
    unknowns: float
    bic: float
    jacobians: int
    compile_s: float
    solve_s: float
    problem: object = dataclasses.field(repr=False, default=None)
    solution: object = dataclasses.field(repr=False, default=None)
    quote: Callable[[], Quoted] = dataclasses.field(repr=False, default=None)
    spectra: tuple = dataclasses.field(repr=False, default=())
    choices: object = dataclasses.field(repr=False, default=None)
    history: tuple = dataclasses.field(repr=False, default=())  # (stage, Jacobian, chi2/N) of every step taken

    @functools.cached_property
    def quoted(self) -> Quoted:
        """What it says of its parameters; made when it is first asked for."""
        return self.quote()

    @property
    def refined(self):
        """The solution that the parameters are quoted from."""
        return self.quoted.refined

    @property
    def estimates(self) -> tuple:
        """Every parameter with its error."""
        return self.quoted.estimates

    @property
    def correlations(self) -> dict:
        """Correlation of each pair of free physical parameters: "a~b" -> coefficient."""
        return self.quoted.correlations

    @property
    def message(self) -> str:
        """The outcome in words."""
        return self.quoted.message

    def estimate(self, name: str):
        """The estimate of one parameter by name; raises `ConfigurationError` where it has no such."""
        found = next((e for e in self.estimates if e.name == name), None)
        if found is None:
            raise ConfigurationError(f'the fit has no parameter "{name}"; it has {", ".join(e.name for e in self.estimates)}')
        return found

    @property
    def cells(self) -> dict:
        """How many cells of the plane some recording switches, and how many there are: masses of the others are not identified."""
        seen = visited_cells(self.actuator, self.spectra)
        return {"switched": int(seen.sum()), "all": int(seen.shape[0] * (seen.shape[0] + 1) // 2)}

    def __str__(self):
        lines = [f"{'converged' if self.converged else 'NOT CONVERGED'}: {self.message}", ""]
        lines += [f"  {e}" for e in self.estimates if e.free]
        width = max([30, *(len(Path(r.file).name) for r in self.recordings)])
        lines += ["", f"  {'recording':{width}s} {'f / Hz':>8s} {'noise':>10s} {'residual':>10s} {'chi2/N':>8s}"]
        for r in self.recordings:
            lines.append(
                f"  {Path(r.file).name:{width}s} {r.frequency:8.4g} {r.noise_rms:10.3g} {r.residual_rms:10.3g} {r.chi2_per_sample:8.3g}"
            )
        lines.append("")
        lines.append(
            f"  chi2/N = {self.chi2_per_sample:.3g} over {self.data_count} numbers, about {self.unknowns:.0f} effective unknowns, "
            f"{self.jacobians} Jacobians in {self.solve_s:.2f} s"
        )
        return "\n".join(lines)

    def as_dict(self) -> dict:
        """The content of fit.json."""
        return {
            "converged": bool(self.converged),
            "message": self.message,
            "bench": self.bench.name,
            "recordings": [dataclasses.asdict(r) for r in self.recordings],
            "parameters": {
                e.name: {
                    "value": e.value, "stderr": e.stderr, "unit": e.unit, "meaning": e.meaning, "free": e.free,
                    "start": e.start, "at_bound": e.at_bound, "identified": e.identified, "why": e.why,
                }
                for e in self.estimates
            },
            "correlations": self.correlations,
            "cells": self.cells,
            "density": in_words(self.choices) if self.choices else None,
            "levels": int(self.actuator.hysteresis.cells),
            "chi2_per_sample": self.chi2_per_sample,
            "bic": self.bic,
            "data_count": int(self.data_count),
            "effective_unknowns": float(self.unknowns),
            "history": [list(step) for step in self.history],
            "jacobians": self.jacobians,
            "compile_s": self.compile_s,
            "solve_s": self.solve_s,
        }  # fmt: skip


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all."""
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def model_as_dict(actuator, bench) -> dict:
    """Everything that simulates the actuator again, bit for bit."""
    hysteresis = actuator.hysteresis
    return {
        "bench": {**dataclasses.asdict(bench)},
        "output": actuator.output,
        "parameters": {n: float(np.asarray(v)) for n, (v, _) in actuator.parameters().items()},
        "effects": [e.name for e in actuator.effects],
        **{e.name: e.settings() for e in actuator.effects if e.name == "learned_term"},
        "hysteresis": {
            "low": float(hysteresis.low), "high": float(hysteresis.high), "offset": float(hysteresis.offset),
            "rest": float(hysteresis.rest), "history": np.asarray(hysteresis.history).tolist(), "masses": np.asarray(hysteresis.masses).tolist(),
        },
    }  # fmt: skip


def write_model(folder: Path, actuator, bench) -> None:
    """model.json in a folder; none, and no earlier one, where a fit broke down."""
    model = model_as_dict(actuator, bench)
    if not all(np.isfinite(v) for v in model["parameters"].values()) or not np.isfinite(model["hysteresis"]["masses"]).all():
        (folder / "model.json").unlink(missing_ok=True)
        return
    write_atomically(folder / "model.json", json.dumps(model))
