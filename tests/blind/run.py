"""Run a suite through the command line: `python -m tests.blind.run dev --out results --workers 2` (resumable).

One folder a case: recordings, the command's own results, and done.json with exit status and time. Labels stay outside.
"""

import argparse
import concurrent.futures
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from .cases import SUITES, make_case, seal, write_case


def run_case(suite, number, out):
    """One case, skipped where it is done."""
    case = make_case(suite, number)
    folder = Path(out) / case.name
    done = folder / "done.json"
    if done.exists():
        return case.name
    shutil.rmtree(folder, ignore_errors=True)
    write_case(case, folder)
    fit, check = sorted(folder.glob("fit_*.csv")), sorted(folder.glob("check_*.csv"))
    command = [sys.executable, "-m", "magjax", "diagnose", *map(str, fit), "--bench", str(folder / "bench.toml"), "--check", *map(str, check), "--out", str(folder / "result"), "--quiet"]
    begin = time.time()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    done.write_text(json.dumps({"status": ended.returncode, "seconds": time.time() - begin, "last": ended.stderr[-500:]}))
    for path in fit + check:
        path.unlink()  # they follow from the case
    return case.name


def main():
    """Parse and run."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--out", default="blind-results")
    p.add_argument("--workers", type=int, default=1)
    p.add_argument("--numbers", type=int, nargs="*")
    options = p.parse_args()
    print(f"{options.suite}: labels sealed as {seal(options.suite)}", flush=True)
    numbers = options.numbers or range(SUITES[options.suite])
    with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        for name in pool.map(lambda k: run_case(options.suite, k, options.out), numbers):
            print(name, flush=True)


if __name__ == "__main__":
    main()
