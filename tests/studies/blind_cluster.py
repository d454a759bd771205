"""The blind suites over a dask cluster: `python -m tests.studies.blind_cluster dev --scheduler ADDRESS --out blind-results`.

Workers have this checkout and see the folder; a case is done.json there, so nothing is run twice.
"""

import argparse
from pathlib import Path

from magjax.scale import Chunk, Job, run_job
from tests.blind.cases import SUITES, size
from tests.blind.run import run_case


def job_case(inputs, number, rng):
    """A case as a chunk of a job; done.json keeps it, so that the job needs no checkpoint."""
    return run_case(inputs["suite"], number, Path(inputs["out"]))


def over_dask(suite: str, numbers, out: Path, scheduler: str):
    """done.json of the cases, run on a dask cluster whose workers have this checkout and see `out`."""
    chunks = tuple(Chunk(f"case {n}", n) for n in numbers)
    job = Job(f"blind {suite}", job_case, {"suite": suite, "out": str(out.resolve())}, chunks)
    return run_job(job, f"dask:{scheduler}").results


def main():
    """One line a case."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--scheduler", required=True)
    p.add_argument("--out", type=Path, default=Path("blind-results"))
    options = p.parse_args()
    for ended in over_dask(options.suite, range(size(options.suite)), options.out, options.scheduler):
        print(ended["name"], ended["status"], ended.get("seconds", ""))


if __name__ == "__main__":
    main()
