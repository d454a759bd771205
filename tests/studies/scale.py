"""`python -m tests.studies.scale [PART ...]`: the same numbers on 1, 2 and dask workers, what they gain, what a kill -9 costs.

workers: a 200 x 20 sweep of the fitted actuator and a 200-draw bootstrap of a fit, in this process, on 1 and 2 processes and on
a dask cluster of 2 workers of one thread. killed: both as commands, of which a worker and then the whole command is killed by
-9. batch: refits of a bootstrap ten at a time against one by one. costs: the single numbers of a million fits on paper.
Times are of a busy or an idle machine as it was: the load average is kept beside them. Results in scale.json.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
import numpy as np  # noqa: E402
import xarray as xr  # noqa: E402

from fitting.demo import SINES, concealed_actuator, record  # noqa: E402
from fitting.fit import fit  # noqa: E402
from fitting.placebo import placebo  # noqa: E402
from fitting.scale import bootstrap_intervals, fit_fleet, profile_intervals  # noqa: E402
from fitting.scale.bootstrap import model_lines, parametric_noise  # noqa: E402
from fitting.scale.refit import lean, settle, settle_each, with_lines  # noqa: E402
from magjax.bench import load_bench  # noqa: E402
from magjax.cli.runtime import prepare_jax  # noqa: E402
from magjax.scale import Chunk, Job, run_job  # noqa: E402
from magjax.scale.codec import decode, digest  # noqa: E402
from magjax.simulate import sweep  # noqa: E402
from magjax.writers import write_recording  # noqa: E402
from tests.scale import works  # noqa: E402

FREQUENCIES, AMPLITUDES = np.linspace(10, 300, 200), np.linspace(0.05, 0.8, 20)
ROOT = Path(__file__).resolve().parents[2]
COMMAND = (sys.executable, "-m", "magjax")


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
    return rows


def compared(rows, run="second"):
    """The rows with their gain over the first."""
    first = next(iter(rows.values()))[run]
    for row in rows.values():
        row["identical"] = all(row[r]["numbers"] == first["numbers"] for r in row)
        row["speed_up"] = round(first["seconds"] / row[run]["seconds"], 2)
        row["speed_up_after_the_first_chunk"] = round(row[run]["chunks_per_s_after_it"] / first["chunks_per_s_after_it"], 2)
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
    return subprocess.Popen([*COMMAND, *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(checkpoint, least, process):
    """Until so many chunks are written, or the command has ended."""
    while lines(checkpoint) < least + 1 and process.poll() is None:
        time.sleep(0.005)


def bootstrap_command(folder: Path):
    """Arguments of the bootstrap, and what reads its numbers."""
    files = [str(p) for p in sorted(folder.glob("rec_*.csv"))]
    command = ["fit", *files, "--bench", "aa-050h", "--bootstrap", "200", "--workers", "2", "--quiet"]
    return command, lambda out: json.loads((out / "fit.json").read_text())["bootstrap"]["parameters"]


def sweep_command():
    """Arguments of the sweep, and what reads its numbers."""
    command = ["sweep", "--frequencies", "10:300:200", "--amplitudes", "0.05:0.8:20"]

    def numbers(out):
        with xr.open_dataset(out, engine="h5netcdf") as found:
            return [found[k].values for k in sorted(found.data_vars)]

    return [*command, "--workers", "2"], numbers


def killed(folder: Path, command, numbers, one: int, two) -> dict:
    """A command: undisturbed; a worker killed at chunk `one`; the command killed at each chunk of `two` and resumed."""

    def ended(name, process):
        text, error = process.communicate()
        said = [x.strip() for x in text.splitlines() if "chunks in" in x]
        return {"exit_status": process.returncode, "said": said or error, "numbers": digest(numbers(folder / name))}

    def given(name):
        return [*command, "--out", str(folder / name)]

    rows = {"undisturbed": ended("plain", start(given("plain")))}
    process = start([*given("worker"), "--checkpoint", str(folder / "worker.kept")])
    wait_for(folder / "worker.kept", one, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    rows["worker killed"] = ended("worker", process)
    kept, counts = folder / "job.kept", []
    for least in two:
        process = start([*given("job"), "--checkpoint", str(kept)])
        wait_for(kept, least, process)
        process.kill()
        process.communicate()
        counts.append(lines(kept) - 1)
    resumed = start([*given("job"), "--checkpoint", str(kept)])
    rows["command killed twice"] = {"chunks_kept": counts, **ended("job", resumed), "chunks_at_the_end": lines(kept) - 1}
    for row in rows.values():
        row["identical"] = row["numbers"] == rows["undisturbed"]["numbers"]
        print(row, flush=True)
    return rows


def cpu() -> float:
    """Seconds of a core that this process has used."""
    return time.process_time()


def batch(result, count: int = 50, rounds: int = 3) -> dict:
    """Refits ten at a time against one by one, in turns: seconds of a core each, and how far the numbers differ."""
    problem, weights = lean(result.problem), result.refined.weights
    centre, rng = settle(problem, result.refined.z, weights), np.random.default_rng(0)
    drawn = model_lines(problem, centre.z) + np.stack([parametric_noise(problem.target, rng) for _ in range(count)])

    def alone():
        return [settle(with_lines(problem, row), centre.z, weights, jacobian=centre.jacobian) for row in drawn]

    def together():
        return settle_each(problem, drawn, centre.z, weights, centre.jacobian)

    rows = {"one by one": [], "ten at a time": []}
    for name, work in ((n, w) for _ in range(rounds + 1) for n, w in zip(rows, (alone, together), strict=True)):
        begin, load = cpu(), os.getloadavg()[0]
        work()
        rows[name].append({"ms_of_a_core_each": round(1e3 * (cpu() - begin) / count, 2), "load_before": round(load, 1)})
        print(name, rows[name][-1], flush=True)
    best = {name: min(r["ms_of_a_core_each"] for r in row[1:]) for name, row in rows.items()}
    one, ten = (np.stack([s.z for s in w()]) for w in (alone, together))
    inside = one.std(axis=0) > 0
    apart = float(np.abs((one - ten)[:, inside] / one.std(axis=0)[inside]).max())
    return {**rows, "gain": round(best["one by one"] / best["ten at a time"], 2), "differ_in_deviations": apart}


FLEET = """
import json, resource, sys
from magjax.cli.runtime import prepare_jax
prepare_jax()
from fitting.scale import fit_fleet
fit_fleet(sys.argv[2:], "aa-050h", checkpoint=sys.argv[1] or None, models=bool(sys.argv[1]))
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss]))
"""


def costs(result, recordings, folder: Path, executors) -> dict:
    """What a fit, a worker, a chunk, a profile and a placebo cost, each by itself; CPU times hardly mind other work."""
    copies = [folder / f"rod{k}" for k in range(7)]
    for copy in copies:
        copy.mkdir()
        for path in folder.glob("rec_*.csv"):
            shutil.copy(path, copy / path.name)

    def used(number, kept=""):
        command = [sys.executable, "-c", FLEET, str(kept), *map(str, copies[:number])]
        return json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()[-1])

    used(1)  # programs into the cache
    (first, _), (many, memory) = used(1), used(7, folder / "models.kept")
    plain = fit_fleet(copies[:2], "aa-050h", checkpoint=folder / "rows.kept")
    sizes = [len(line) for line in (folder / "rows.kept").read_bytes().splitlines()[1:]]
    models = [len(line) for line in (folder / "models.kept").read_bytes().splitlines()[1:]]
    found = {
        "recordings": plain.rows[0]["recordings"], "csv_bytes_of_a_folder": sum(p.stat().st_size for p in copies[0].iterdir()),
        "jacobians": [r["jacobians"] for r in plain.rows], "fit_cpu_s": round((many - first) / 6, 2),
        "first_fit_of_a_process_cpu_s": round(first, 2), "worker_max_rss_MB": round(memory / 1e3), "checkpoint_bytes": int(np.mean(sizes)),
        "checkpoint_bytes_with_model": int(np.mean(models)),
    }  # fmt: skip
    tracemalloc.start()
    rows = [decode(json.loads((folder / "rows.kept").read_bytes().splitlines()[1][9:])["result"]) for _ in range(50)]
    found["row_bytes_in_memory"] = tracemalloc.get_traced_memory()[0] // len(rows)
    tracemalloc.stop()
    empty = Job("nothing", works.nothing, {}, tuple(Chunk(str(k), k) for k in range(1000)))
    for label, executor in executors.items():
        for kept in (None, folder / f"empty {label}"):
            run_job(dataclasses.replace(empty, chunks=empty.chunks[:20]), executor)
            begin, wall = cpu(), time.perf_counter()
            seen = []
            run_job(empty, executor, checkpoint=kept, progress=lambda *_, seen=seen: seen.append((time.perf_counter(), cpu())))
            each = (seen[-1][0] - seen[0][0], seen[-1][1] - seen[0][1])
            name = f"empty chunk, {label}{', checkpoint' if kept else ''}"
            found[name] = {"ms": round(each[0], 2), "ms_of_a_core_here": round(each[1], 2)}
            print(name, found[name], round(time.perf_counter() - wall, 1), round(cpu() - begin, 1), flush=True)
    for name, count, work in (
        ("profile, a parameter", len(result.problem.layout.names), lambda: profile_intervals(result)),
        ("bootstrap, 200 draws", 1, lambda: bootstrap_intervals(result, 200)),
        ("placebo, a search", 3, lambda: placebo(result, recordings, 3)),
    ):
        work()
        begin = cpu()
        work()
        found[f"{name}, cpu s"] = round((cpu() - begin) / count, 3)
        print(name, found[f"{name}, cpu s"], flush=True)
    return found


PARTS = ("workers", "killed", "batch", "costs")


def main():
    """Run the parts asked for and write them into scale.json; the others stay."""
    import dask
    import distributed

    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("parts", nargs="*", help=f"{', '.join(PARTS)} (default all)")
    p.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = p.parse_args()
    parts = options.parts or PARTS
    prepare_jax()
    truth, rng = concealed_actuator(load_bench("aa-050h")), np.random.default_rng(7)
    recordings = [record(truth, *drive, rng, f"rec_{drive[0]:03d}Hz.csv") for drive in SINES]
    result = fit(recordings, "aa-050h")
    content = json.loads(options.out.read_text()) if options.out.exists() else {}
    content |= {"cores": os.cpu_count(), "jax": jax.__version__}
    content["load averages"] = {**content.get("load averages", {}), **dict.fromkeys(parts, [round(x, 1) for x in os.getloadavg()])}
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        folder = Path(place)
        for recording in recordings:
            write_recording(folder / recording.name, recording)
        executors = {"this process": None, "1 process": "processes:1", "2 processes": "processes:2"}

        def with_dask():
            """The same on a dask cluster of this machine; up for these rows alone, for its processes are never quite idle. The
            environment that dask gives its workers (one OpenMP thread, memory handed back at every turn) halves their speed."""
            stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": {"OPENBLAS_NUM_THREADS": "1"}}))
            cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
            return {"dask, 2 workers": f"dask:{stack.enter_context(cluster).scheduler_address}"}

        if "batch" in parts:
            content["batch"] = batch(result)
        if "workers" in parts:
            grid = {"frequencies": FREQUENCIES, "amplitudes": AMPLITUDES, "offsets": (0.1,)}

            def swept(executor, progress):
                return [v.values for v in sweep(result.actuator, **grid, executor=executor, progress=progress).data_vars.values()]

            def drawn(count):
                return lambda executor, progress: bootstrap_intervals(result, count, executor=executor, progress=progress).draws

            fewer = {k: v for k, v in executors.items() if k != "1 process"}
            jobs = {
                "sweep 200 x 20": ("sweep", swept, executors), "bootstrap of 200": ("bootstrap", drawn(200), executors),
                "bootstrap of 1000": ("long bootstrap", drawn(1000), fewer, ("second",)),
            }  # fmt: skip
            rows, up = {key: timed(*job) for key, job in jobs.items()}, with_dask()
            for key, (name, work, _, *runs) in jobs.items():
                content[key] = compared(rows[key] | timed(name, work, up, *runs))
        if "killed" in parts:
            for name in ("bootstrap", "sweep"):
                (folder / name).mkdir()
            content["killed by -9"] = {
                "sweep": killed(folder / "sweep", *sweep_command(), 2, (1, 3)),
                "bootstrap": killed(folder / "bootstrap", *bootstrap_command(folder), 5, (5, 12)),
            }
        if "costs" in parts:
            content["costs"] = costs(result, recordings, folder, executors | with_dask())
    options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
