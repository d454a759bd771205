"""Run a suite through the command line: `python -m tests.blind.run dev --out blind-results --workers 2`.

The cases are the chunks of a job of `magjax.scale`: on processes of this machine or, with --scheduler, on dask workers that
have this checkout and see the folder; a worker that is killed costs its case only. Resumable: a case with done.json is
skipped, and with --kept FILE.jsonl (see `score`) one that stands there. Each case is the command in a process of its own;
its folder holds the results and done.json (exit status, seconds, peak memory). Recordings are written, used and removed,
for they follow from the case.
"""

import argparse
import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from .cases import SEALS, SUITES, make_case, seal, size, write_case

GENERATOR_FAILED = -2
COMMAND = (sys.executable, "-m", "magjax")
LIMIT = 1200.0  # s, for a case
END_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux


def run_case(suite: str, number: int, out: Path, limit: float = LIMIT, command=COMMAND) -> dict:
    """done.json of one case, run where it is not there yet; `limit` seconds; `command`: what stands before "diagnose"."""
    case = make_case(suite, number)
    folder = Path(out) / case.name
    done = folder / "done.json"
    if done.exists():
        return json.loads(done.read_text())
    shutil.rmtree(folder, ignore_errors=True)
    try:
        write_case(case, folder)
    except RuntimeError as error:  # the generator's own failure is told, and the suite goes on
        ended = {"status": GENERATOR_FAILED, "seconds": 0.0, "peak_MB": 0, "last": str(error)}
    else:
        ended = diagnose(folder, folder / "result", limit, command)
    part = folder / "done.part"
    part.write_text(json.dumps({"name": case.name, **ended}))
    part.replace(done)
    for path in folder.glob("*.csv"):
        path.unlink()
    return json.loads(done.read_text())


def _end_with_worker():
    """A command whose worker was killed must not write on beside the one that takes the case over."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(END_WITH_PARENT, signal.SIGKILL)


def diagnose(folder: Path, result: Path, limit: float = LIMIT, command=COMMAND) -> dict:
    """The command on a folder of recordings: exit status, seconds, peak memory, last words."""
    fit, check = sorted(map(str, folder.glob("fit_*.csv"))), sorted(map(str, folder.glob("check_*.csv")))
    command = [*command, "diagnose", *fit, "--bench", str(folder / "bench.toml")]
    command += ["--check", *check] if check else []
    command += ["--json", "--quiet", "--out", str(result)]
    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "MPLBACKEND": "Agg",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    }
    result.mkdir(parents=True, exist_ok=True)
    begin, words = time.time(), folder / "stderr.txt"
    with (result / "stdout.json").open("w") as out, words.open("w") as err:
        process = subprocess.Popen(command, stdout=out, stderr=err, env=environment, preexec_fn=_end_with_worker)
        late = threading.Timer(limit, process.kill)
        late.start()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        late.cancel()
    seconds = time.time() - begin
    last = words.read_text()[-400:] if seconds < limit else f"stopped after {limit:g} s"
    words.unlink()
    return {"status": process.returncode, "seconds": round(seconds, 1), "peak_MB": round(used.ru_maxrss / 1e3), "last": last}


def case_of_job(inputs, number, rng):
    """A case as a chunk of a job: its done.json is its checkpoint."""
    if time.time() > inputs["until"]:
        return {"name": f"{inputs['suite']}-{number:03d}", "status": "not started"}
    return run_case(inputs["suite"], number, Path(inputs["out"]), inputs["limit"], inputs["command"])


def run_cases(suite: str, numbers, out: Path, executor=None, *, until=float("inf"), limit=LIMIT, command=COMMAND, progress=None):
    """`Outcome` of a job whose results are done.json of the cases; `executor` and `progress` as in `magjax.scale.run_job`,
    `until`: time.time() after which none is begun."""
    from magjax.scale import Chunk, Job, run_job

    from .run import case_of_job  # by its own name where this file is the main program: workers import it

    inputs = {"suite": suite, "out": str(Path(out).resolve()), "until": until, "limit": limit, "command": list(command)}
    chunks = tuple(Chunk(f"{suite}-{n:03d}", n) for n in numbers)
    return run_job(Job(f"blind suite {suite}", case_of_job, inputs, chunks), executor, progress=progress)


def main():
    """Check the seal, run what is not done, one line a case as it ends."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--out", type=Path, default=Path("blind-results"))
    p.add_argument("--workers", type=int, default=1)
    p.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler, in place of --workers")
    p.add_argument("--numbers", type=int, nargs="*", help="only these cases")
    p.add_argument("--kept", type=Path, nargs="*", default=[], help="files of score --keep: their cases are not run again")
    p.add_argument("--until", type=float, default=float("inf"), help="start no case after this many seconds")
    options = p.parse_args()
    if json.loads(SEALS.read_text())[options.suite]["sha256"] != seal(options.suite):
        sys.exit(f"the labels of {options.suite} are not the sealed ones of {SEALS.name}: a case was changed after the seal")
    kept = {json.loads(line)["name"] for file in options.kept for line in file.read_text().splitlines()}
    numbers = range(size(options.suite)) if options.numbers is None else options.numbers
    numbers = [k for k in numbers if f"{options.suite}-{k:03d}" not in kept]
    told = set()

    def tell(*_):
        for done in sorted(options.out.glob(f"{options.suite}-*/done.json")):
            if done not in told:
                told.add(done)
                ended = json.loads(done.read_text())
                print(ended["name"], ended["status"], ended["seconds"], flush=True)

    executor = f"dask:{options.scheduler}" if options.scheduler else f"processes:{options.workers}"
    outcome = run_cases(options.suite, numbers, options.out, executor, until=time.time() + options.until, progress=tell)
    left = sum(row["status"] == "not started" for row in outcome.results)
    print(f"{len(outcome.results) - left} of {len(outcome.results)} cases done, {outcome.lost} workers lost and replaced")


if __name__ == "__main__":
    main()
