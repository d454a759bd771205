"""`python -m tests.studies.scale`: the same numbers on 1, 2 and dask workers, what they gain, what a kill -9 costs.

A 200 x 20 sweep of the fitted actuator and a 200-draw bootstrap of a fit, in this process, on 1 and 2 processes and on a
dask cluster of 2 workers of one thread; a worker and the whole command killed by -9 while they work. Times are of a busy
or an idle machine as it was: the load average is kept beside them. Results in scale.json.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
import numpy as np  # noqa: E402

from fitting.demo import SINES, concealed_actuator, record  # noqa: E402
from fitting.fit import fit  # noqa: E402
from fitting.scale import bootstrap_intervals  # noqa: E402
from magjax.bench import load_bench  # noqa: E402
from magjax.cli.runtime import prepare_jax  # noqa: E402
from magjax.scale.codec import digest  # noqa: E402
from magjax.simulate import sweep  # noqa: E402
from magjax.writers import write_recording  # noqa: E402

FREQUENCIES, AMPLITUDES = np.linspace(10, 300, 200), np.linspace(0.05, 0.8, 20)
ROOT = Path(__file__).resolve().parents[2]


def timed(name, work, executors, runs=("first", "second")):
    """Seconds, digest of the numbers and chunks a second once the first chunk is done, on each executor.

    The first run of each compiles or loads programs; fresh processes load them in every run.
    """
    rows = {}
    for label, executor in executors.items():
        for run in runs:
            load, begin, seen = os.getloadavg()[0], time.perf_counter(), []
            numbers = work(executor, lambda *_, seen=seen: seen.append(time.perf_counter()))
            row = rows.setdefault(label, {})
            row[run] = {
                "seconds": round(time.perf_counter() - begin, 2), "to_the_first_chunk_s": round(seen[0] - begin, 2),
                "chunks_per_s_after_it": round((len(seen) - 1) / max(seen[-1] - seen[0], 1e-9), 2), "load_before": round(load, 1),
                "numbers": digest(numbers),
            }  # fmt: skip
            print(name, label, run, row[run], flush=True)
    first = next(iter(rows.values()))[runs[-1]]
    for row in rows.values():
        row["identical"] = all(row[r]["numbers"] == first["numbers"] for r in runs)
        row["speed_up"] = round(first["seconds"] / row[runs[-1]]["seconds"], 2)
        row["speed_up_after_the_first_chunk"] = round(row[runs[-1]]["chunks_per_s_after_it"] / first["chunks_per_s_after_it"], 2)
    return rows


def workers_of(number: int) -> list[int]:
    """Processes that a command spawned, without the one that tracks its resources."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if (
                int(path.read_text().rsplit(")", 1)[1].split()[1]) == number
                and b"resource_tracker" not in (path.parent / "cmdline").read_bytes()
            ):
                found.append(int(path.parent.name))
    return found


def lines(checkpoint: Path) -> int:
    """Whole lines of a checkpoint."""
    return checkpoint.read_bytes().count(b"\n") if checkpoint.exists() else 0


def start(arguments):
    """A command as a user starts it."""
    return subprocess.Popen([sys.executable, "-m", "magjax", *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True)


def wait_for(checkpoint, least, process):
    """Until so many chunks are written, or the command has ended."""
    while lines(checkpoint) < least + 1 and process.poll() is None:
        time.sleep(0.02)


def killed(folder: Path) -> dict:
    """`magjax fit --bootstrap 200 --workers 2`: undisturbed; a worker killed; the command killed twice and resumed."""
    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    command = ["fit", *files, "--bench", "aa-050h", "--bootstrap", "200", "--workers", "2", "--quiet"]

    def ended(name, process):
        text, _ = process.communicate()
        draws = json.loads((folder / name / "fit.json").read_text())["bootstrap"]["parameters"]
        return {
            "exit_status": process.returncode,
            "said": [x.strip() for x in text.splitlines() if "chunks in" in x][0],
            "numbers": digest(draws),
        }

    rows = {"undisturbed": ended("plain", start([*command, "--out", str(folder / "plain")]))}
    process = start([*command, "--out", str(folder / "worker"), "--checkpoint", str(folder / "worker.kept")])
    wait_for(folder / "worker.kept", 5, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    rows["worker killed"] = ended("worker", process)
    kept, counts = folder / "job.kept", []
    for least in (5, 12):
        process = start([*command, "--out", str(folder / "job"), "--checkpoint", str(kept)])
        wait_for(kept, least, process)
        process.kill()
        process.communicate()
        counts.append(lines(kept) - 1)
    rows["command killed twice"] = {
        "chunks_kept": counts,
        **ended("job", start([*command, "--out", str(folder / "job"), "--checkpoint", str(kept)])),
    }
    for row in rows.values():
        row["identical"] = row["numbers"] == rows["undisturbed"]["numbers"]
        print(row, flush=True)
    return rows


def main():
    """Run all and write scale.json."""
    import distributed

    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = p.parse_args()
    prepare_jax()
    truth, rng = concealed_actuator(load_bench("aa-050h")), np.random.default_rng(7)
    recordings = [record(truth, *drive, rng, f"rec_{drive[0]:03d}Hz.csv") for drive in SINES]
    result = fit(recordings, "aa-050h")
    again = fit(recordings, "aa-050h")
    content = {
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "fit": {"compile_s": result.compile_s, "solve_s": again.solve_s, "jacobians": again.jacobians},
    }
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        executors = {
            "this process": None,
            "1 process": "processes:1",
            "2 processes": "processes:2",
            "dask, 2 workers": f"dask:{cluster.scheduler_address}",
        }
        grid = {"frequencies": FREQUENCIES, "amplitudes": AMPLITUDES}

        def swept(executor, progress):
            return [v.values for v in sweep(result.actuator, **grid, executor=executor, progress=progress).data_vars.values()]

        def drawn(count):
            return lambda executor, progress: bootstrap_intervals(result, count, executor=executor, progress=progress).draws

        content["sweep 200 x 20"] = timed("sweep", swept, executors)
        content["bootstrap of 200"] = timed("bootstrap", drawn(200), executors)
        content["bootstrap of 1000"] = timed(
            "long bootstrap", drawn(1000), {k: v for k, v in executors.items() if k != "1 process"}, ("second",)
        )
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for recording in recordings:
            write_recording(folder / recording.name, recording)
        content["killed by -9"] = killed(folder)
    options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
