"""Write a result folder: the JSON that others read, the model, the evidence of the report, and the report itself."""

import json
import math
import platform
from importlib import metadata
from pathlib import Path

import numpy as np

from magjax.terms import MAGNETIC
from magjax.writers import as_json

from ..result import write_atomically, write_model
from . import store
from .page import rebuild


def write_fit(folder: Path, result, recordings, content: dict, reproduce: str, progress=None, checks=()) -> None:
    """Write fit.json, model.json, report.npz, figures and report.html of a fit.

    `progress(text)` at every step; `checks`: the check recordings, drawn.
    """
    from . import evidence

    folder = Path(folder)
    content = {**content, "reproduce": reproduce, "versions": versions()}
    _write_numbers(folder / "fit.json", content)
    write_model(folder, result.actuator, result.bench)
    _say(progress, "report: signals")
    found = {**evidence.of_fit(result), "drive": result.bench.drive}
    if checks:
        found["checks"] = evidence.of_checks(result.actuator, result.actuator, checks, result.bench)
    store.save(folder, found)
    rebuild(folder, progress)


def write_diagnosis(
    folder: Path, diagnosis, recordings, content: dict, reproduce: str, checks=(), progress=None, bench=None, shown=None
) -> None:
    """Write diagnosis.json, the repaired model, report.npz, figures and report.html of a diagnosis.

    `checks`: the check recordings, drawn before and after; `progress(text)` at every step; `bench`: where no fit tells it;
    `shown`: where a file is at fault, as a `RecordingError` holds it.
    """
    from . import evidence

    folder = Path(folder)
    content = {**content, "reproduce": reproduce, "versions": versions()}
    _write_numbers(folder / "diagnosis.json", content)
    base, repaired = diagnosis.base, diagnosis.repaired
    best = repaired or base
    found = {}
    if best is None:
        (folder / "model.json").unlink(missing_ok=True)  # of an earlier result
    else:
        write_model(folder, best.actuator, best.bench)
        found["drive"] = best.bench.drive
    _say(progress, "report: signals")
    if diagnosis.verdict == "data_problem" or (base is not None and not math.isfinite(base.chi2_per_sample)):
        named_first = sorted(recordings, key=lambda r: r.name not in diagnosis.message)
        found["recordings"] = evidence.of_recordings(named_first)
        found |= {"bench": np.array(bench.name)} if bench else {}
        found |= {"offender": evidence.of_offender(shown)} if shown else {}
    elif base is not None:
        found["base"] = evidence.of_fit(base, inside=repaired is None)
        found["catalogue"] = json.dumps(catalogue(base.bench.terms))
        if repaired is not None:
            found["repaired"] = evidence.of_fit(repaired, chosen=[int(k) for k in found["base"]["chosen"]])
        _, checks = diagnosis.parted(checks)
        if checks:
            own_zeros = all(s.zero for s in best.spectra)
            found["checks"] = evidence.of_checks(base.actuator, best.actuator, checks, best.bench, own_zeros, diagnosis.cleaned_checks)
    store.save(folder, found)
    rebuild(folder, progress)


def _write_numbers(path: Path, content: dict) -> None:
    """The JSON of a result; the page of an earlier one goes with it, so that none stands beside numbers that are not its own."""
    write_atomically(path, as_json(content, indent=1))
    for name in ("report.html", "report.npz"):
        path.with_name(name).unlink(missing_ok=True)


def catalogue(terms=MAGNETIC) -> dict:
    """What the page tells of each effect: block, law, signature, source, unit and the top of its typical range."""
    from magjax.effects import CATALOGUE

    rows = {}
    for effect in CATALOGUE:
        info = effect.parameters()[effect.amplitude]
        typical = max((abs(t) for t in info.typical), default=None) if info.typical else None
        rows[effect.name] = {
            "block": effect.block, "law": effect.law.rstrip("."), "signature": effect.signature.rstrip("."), "source": effect.source.rstrip("."),
            "unit": terms.unit_of(info.unit), "typical": typical,
        }  # fmt: skip
    return rows


def versions() -> str:
    """magjax and what its numbers rest on."""
    names = [f"{name} {metadata.version(name)}" for name in ("magjax", "jax", "numpy")]
    return ", ".join([*names, f"Python {platform.python_version()}"])


def _say(progress, text):
    if progress is not None:
        progress(text)
