"""Run a suite through the command line: `python -m tests.blind.run dev --out blind-results --workers 2`.

Resumable: a case with done.json is skipped, and with --kept FILE.jsonl (see `score`) one that stands there; every case is a
process of its own. One folder a case holds the command's results and done.json (exit status, seconds, peak memory);
recordings are written, used and removed, for they follow from the case.
"""

import argparse
import concurrent.futures
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

from .cases import SEALS, SUITES, make_case, seal, size, write_case

GENERATOR_FAILED = -2


def run_case(suite: str, number: int, out: Path, limit: float = 1200.0) -> dict:
    """done.json of one case, run where it is not there yet; `limit` seconds."""
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
        ended = diagnose(folder, folder / "result", limit)
    part = folder / "done.part"
    part.write_text(json.dumps({"name": case.name, **ended}))
    part.replace(done)
    for path in folder.glob("*.csv"):
        path.unlink()
    return json.loads(done.read_text())


def diagnose(folder: Path, result: Path, limit: float) -> dict:
    """The command on a folder of recordings: exit status, seconds, peak memory, last words."""
    fit, check = sorted(map(str, folder.glob("fit_*.csv"))), sorted(map(str, folder.glob("check_*.csv")))
    command = [sys.executable, "-m", "magjax", "diagnose", *fit, "--bench", str(folder / "bench.toml")]
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
        process = subprocess.Popen(command, stdout=out, stderr=err, env=environment)
        late = threading.Timer(limit, process.kill)
        late.start()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        late.cancel()
    seconds = time.time() - begin
    last = words.read_text()[-400:] if seconds < limit else f"stopped after {limit:g} s"
    words.unlink()
    return {"status": process.returncode, "seconds": round(seconds, 1), "peak_MB": round(used.ru_maxrss / 1e3), "last": last}


def main():
    """Check the seal, run what is not done, one line a case."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--out", type=Path, default=Path("blind-results"))
    p.add_argument("--workers", type=int, default=1)
    p.add_argument("--numbers", type=int, nargs="*", help="only these cases")
    p.add_argument("--kept", type=Path, nargs="*", default=[], help="files of score --keep: their cases are not run again")
    p.add_argument("--until", type=float, default=float("inf"), help="start no case after this many seconds")
    options = p.parse_args()
    if json.loads(SEALS.read_text())[options.suite]["sha256"] != seal(options.suite):
        sys.exit(f"the labels of {options.suite} are not the sealed ones of {SEALS.name}: a case was changed after the seal")
    begin = time.time()
    kept = {json.loads(line)["name"] for file in options.kept for line in file.read_text().splitlines()}
    numbers = range(size(options.suite)) if options.numbers is None else options.numbers
    numbers = [k for k in numbers if f"{options.suite}-{k:03d}" not in kept]

    def one(number):
        return (
            run_case(options.suite, number, options.out)
            if time.time() - begin < options.until
            else {"name": number, "status": "not started"}
        )

    with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        for ended in pool.map(one, numbers):
            print(ended["name"], ended["status"], ended.get("seconds", ""), flush=True)


if __name__ == "__main__":
    main()
