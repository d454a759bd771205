"""A fleet: many actuators, one folder of recordings each, one fit each, one table.

What cannot be fitted is a row with its reason, never the end of the fleet. Fits of recordings that are alike in number and
form share one compiled program in each worker.
"""

import csv
import dataclasses
import io
import time
from pathlib import Path

import numpy as np

from magjax.bench import load_bench
from magjax.errors import ConfigurationError, MagjaxError
from magjax.recording import load_recordings
from magjax.scale import Chunk, Job, run_job

from ..fit import fit
from ..result import model_as_dict
from ..setup import Choices

ENDINGS = (".csv", ".nc", ".mat", ".mjlog")
OWN_BENCH = "bench.toml"
CHECK = "check_"  # recordings whose names begin so take no part in a fit
FIXED = ("name", "folder", "status", "message", "recordings", "chi2_per_sample", "jacobians", "compile_s", "solve_s", "seconds")
STATES = ("fitted", "not converged", "failed")


@dataclasses.dataclass(frozen=True)
class Fleet:
    """One row an actuator, in the order of the folders.

    `rows`: dicts of FIXED, and "parameters": {name: {value, stderr, unit, ...}}.
    """

    rows: tuple[dict, ...]
    outcome: object = dataclasses.field(repr=False, default=None)

    def count(self, status: str) -> int:
        """How many rows have a status: "fitted", "not converged" or "failed"."""
        return sum(r["status"] == status for r in self.rows)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters that any fit freed."""
        return tuple(dict.fromkeys(n for r in self.rows for n, p in r["parameters"].items() if p["free"]))

    def unit(self, name: str) -> str:
        """Unit of a parameter."""
        return next(r["parameters"][name]["unit"] for r in self.rows if name in r["parameters"])

    def csv(self) -> str:
        """The table as CSV: a line an actuator; NAME and NAME_stderr of each free parameter, SI; empty where not fitted."""
        out = io.StringIO()
        names = self.parameter_names
        writer = csv.writer(out, lineterminator="\n")
        out.writelines(f"# {n}: {self.unit(n)}\n" for n in names)
        writer.writerow([*FIXED, *(c for n in names for c in (n, f"{n}_stderr"))])
        for row in self.rows:
            cells = [row[k] for k in FIXED]
            for name in names:
                found = row["parameters"].get(name, {"value": None, "stderr": None})
                cells += [found["value"], found["stderr"]]
            writer.writerow(["" if c is None else c for c in cells])
        return out.getvalue()

    def dataset(self):
        """The table as an xarray Dataset over "actuator"; NaN where not fitted."""
        import xarray as xr

        def column(values):
            return "actuator", np.asarray([np.nan if v is None else v for v in values], float)

        data = {k: column([r[k] for r in self.rows]) for k in FIXED[4:]}
        data["status"] = ("actuator", np.asarray([r["status"] for r in self.rows], dtype=str))
        data["message"] = ("actuator", np.asarray([r["message"] for r in self.rows], dtype=str))
        for name in self.parameter_names:
            for key, ending in (("value", ""), ("stderr", "_stderr")):
                values = column([r["parameters"].get(name, {}).get(key) for r in self.rows])
                data[name + ending] = (*values, {"units": self.unit(name)})
        return xr.Dataset(data, coords={"actuator": np.asarray([r["name"] for r in self.rows], dtype=str)})

    def __str__(self):
        lines = [", ".join(f"{self.count(s)} {s}" for s in STATES) + f" of {len(self.rows)} actuators"]
        for name in self.parameter_names:
            fitted = [r["parameters"] for r in self.rows if r["status"] == "fitted"]
            values = np.asarray([p[name]["value"] for p in fitted if name in p])
            if len(values):
                low, middle, high = np.percentile(values, (5, 50, 95))
                lines.append(f"  {name:32s} median {middle:<12.6g} {self.unit(name):10s} (5 to 95 %: {low:.5g} to {high:.5g})")
        poor = [r for r in self.rows if r["status"] != "fitted"]
        lines += [f"  {r['status']}: {r['name']}: {r['message']}" for r in poor[:10]]
        return "\n".join([*lines, *([f"  and {len(poor) - 10} more, see the table"] if len(poor) > 10 else [])])


def fit_fleet(
    folders, bench=None, *, choices: Choices = Choices(), executor=None, checkpoint=None, progress=None, models: bool = False
) -> Fleet:
    """Fit each folder's recordings; files whose names begin with "check_" take no part.

    `bench`: for folders without a bench.toml of their own; `models`: keep each row's "model" (content of model.json) and
    "fit" (of fit.json); `executor`, `checkpoint`, `progress` as in `magjax.scale.run_job`: a folder is a chunk, workers
    must see the same paths. A folder whose files have changed since the checkpoint is fitted again; folders may be added.
    Raises `ConfigurationError` where there is no folder or a folder comes twice.
    """
    paths = [Path(f) for f in folders]
    for path in paths:
        if not path.exists():
            raise ConfigurationError(f"{path}: no such folder; check the name")
    found = [p for p in paths if p.is_dir()]  # DIR/* may name files too
    if not found:
        raise ConfigurationError(f"no folder among {len(paths)} paths; give one folder of recordings for each actuator")
    bench = None if bench is None else load_bench(bench)
    chunks = tuple(Chunk(str(f.resolve()), {"folder": str(f.resolve()), "files": _files(f)}) for f in found)
    inputs = {"bench": bench, "choices": choices, "models": models}
    outcome = run_job(Job("fleet", fit_folder, inputs, chunks), executor, checkpoint=checkpoint, progress=progress)
    names = [f.name for f in found]
    labels = [f.name if names.count(f.name) == 1 else str(f).strip("/").replace("/", "_") for f in found]
    return Fleet(tuple({**row, "name": label} for row, label in zip(outcome.results, labels, strict=True)), outcome)


def _files(folder):
    """Recordings and bench of a folder with size and time of change: what tells whether a fit is still theirs."""
    files = []
    for path in sorted(folder.iterdir()):
        fits = path.suffix.lower() in ENDINGS and not path.name.startswith(CHECK)
        if path.is_file() and (fits or path.name == OWN_BENCH):
            state = path.stat()
            files.append([path.name, state.st_size, state.st_mtime_ns])
    return files


def fit_folder(inputs, item, rng):
    """One row of the table; the reason in words where there is no fit."""
    folder, begin = Path(item["folder"]), time.perf_counter()
    row = {**dict.fromkeys(FIXED), "name": folder.name, "folder": str(folder), "status": "failed", "parameters": {}}
    try:
        row |= _fit(inputs, folder, [name for name, *_ in item["files"]])
    except MagjaxError as error:
        row["message"] = str(error)
    except Exception as error:  # a defect that one strange recording brings out must not end a fleet of thousands
        words = str(error).splitlines()[0] if str(error) else "no words"
        row["message"] = f"unexpected {type(error).__name__}: {words} (a defect: please report it with these recordings)"
    row["seconds"] = time.perf_counter() - begin
    return row


def _fit(inputs, folder, files):
    own = folder / OWN_BENCH
    if OWN_BENCH not in files and inputs["bench"] is None:
        raise ConfigurationError(f"{folder}: no {OWN_BENCH} in the folder; put one there or give --bench for all")
    bench = load_bench(own) if OWN_BENCH in files else inputs["bench"]
    paths = [folder / name for name in files if name != OWN_BENCH]
    if not paths:
        raise ConfigurationError(f"{folder}: no recordings ({', '.join(ENDINGS)}) in the folder")
    recordings = load_recordings(paths, bench)
    result = fit(recordings, bench, choices=inputs["choices"])
    content = result.as_dict()
    row = {k: content[k] for k in ("message", "parameters", "chi2_per_sample", "jacobians", "compile_s", "solve_s")}
    row |= {"status": "fitted" if result.converged else "not converged", "recordings": len(recordings)}
    return row | ({"fit": content, "model": model_as_dict(result.actuator, bench)} if inputs["models"] else {})
