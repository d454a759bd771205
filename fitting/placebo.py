"""The placebo: how often does the same search cry wolf on recordings that lack nothing?

The final model stands in for the truth: its harmonics with fresh noise of the stated size are fitted, screened and searched as
the recordings were. Where nothing scores above the threshold the search ends by its own rule, after some seconds; else the
leaders are fitted beside their rivals and what does not earn its place is dropped. A run that adopts an effect cries wolf. A
rough truth that the density cannot follow is not in it: that is what the check recordings and the blind suites are for.
"""

import dataclasses

from magjax.errors import ConfigurationError
from magjax.scale import Chunk, Job, run_job

from .rough import worth_a_search
from .scale.bootstrap import model_lines, parametric_noise
from .scale.refit import lean
from .screen import screened
from .search import search
from .task import Task, freed_beyond
from .verdict import Z_THRESHOLD, too_little


def placebo(result, recordings, runs: int = 20, *, seed: int = 0, executor=None, checkpoint=None, progress=None) -> dict:
    """Search `runs` simulations of the final model for what they do not lack: the entry "placebo" of diagnosis.json.

    `result`: the `final_model` of a `Diagnosis`; `recordings`: those of the diagnosis;
    `executor`, `checkpoint`, `progress` as in `magjax.scale.run_job`, a run is a chunk. Raises `ConfigurationError` below one run.
    """
    if runs < 1:
        raise ConfigurationError(f"a placebo of {runs} runs; give 1 or more, 20 to see false alarms of one in ten")
    lines = model_lines(result.problem, result.solution.z)
    inputs = {"result": _timeless(result), "recordings": tuple(recordings), "lines": lines}
    chunks = tuple(Chunk(f"run {k}", k) for k in range(runs))
    if progress is not None:
        progress(f"placebo, {runs} searches")
    rows = run_job(Job("placebo", searched, inputs, chunks, seed), executor, checkpoint=checkpoint, progress=progress).results
    named = [name for row in rows for name in row["named"]]
    return {
        "procedure": "search", "runs": runs, "false_alarms": sum(bool(row["named"]) for row in rows),
        "named": {name: named.count(name) for name in dict.fromkeys(named)},
        "screening_alarms": sum(row["highest_z"] >= Z_THRESHOLD for row in rows), "highest_z": [row["highest_z"] for row in rows],
    }  # fmt: skip


def final_model(found):
    """The `FitResult` that stands in for the truth: the repaired one, the base where nothing named repairs it."""
    named = found.repaired is not None and not any(e.name == "learned_term" for e in found.repaired.actuator.effects)
    return found.repaired if named else found.base


def _timeless(result):
    """The fit without what differs between two runs of one command, and without what a search does not read."""
    solution = dataclasses.replace(result.solution, seconds=0.0)
    nothing = {"quote": None, "history": (), "compile_s": 0.0, "solve_s": 0.0}
    return dataclasses.replace(result, problem=lean(result.problem), solution=solution, **nothing)


def searched(inputs, number, rng) -> dict:
    """One run: the effects that the search adopts, and the highest |z| of the screening that it began with."""
    result, recordings = inputs["result"], inputs["recordings"]
    lines = inputs["lines"] + parametric_noise(result.problem.target, rng)
    spectra = tuple(_reading(s, row) for s, row in zip(result.spectra, lines, strict=True))
    task = Task(recordings, result.bench, result.choices, actuator=result.actuator)
    base = task.fit_on(result, extra=freed_beyond(result), spectra=spectra)
    candidates = screened(base, result.choices)
    reached = search(task, base, worth_a_search(base, candidates))
    named = [] if too_little(reached, base) else [best.name for best, *_ in reached.steps]
    return {"named": named, "highest_z": max((float(abs(c.z)) for c in candidates), default=0.0)}


def _reading(spectrum, lines):
    """The spectrum with other reading lines; those beyond the fit's stay."""
    reading = spectrum.reading.copy()
    reading[: len(lines)] = lines[: len(reading)]
    return dataclasses.replace(spectrum, reading=reading)
