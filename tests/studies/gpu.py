"""`python -m tests.studies.gpu`: sweeps, a trajectory and a fit on a GPU and on the processors of the same machine, into gpu.json.

Needs a jax that sees a GPU. Each platform runs in a process of its own, one after the other; times are those of a second run, its
programs compiled, and, for the fit, of the first.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__)


def timed(work):
    """Seconds of a second call, and what it returned."""
    work()
    begin = time.perf_counter()
    found = work()
    return time.perf_counter() - begin, found


def one_platform() -> dict:
    """What this process takes, s, and numbers to compare."""
    import jax
    import numpy as np

    from magjax.cli.runtime import prepare_jax

    prepare_jax(many=True)
    from fitting.fit import fit
    from magjax.bench import load_bench
    from magjax.simulate import simulate, sweep
    from tests.benchmarks.run import actuator_at
    from tests.studies.joint_fit import SINES, one_draw, settled

    actuator, times, numbers = actuator_at(), {}, {}
    for count, chunk in ((4000, 512), (4000, 4000), (40_000, 40_000)):
        grid = np.linspace(5, 400, count // 20), np.linspace(0.05, 0.8, 20), 0.1
        name = f"{count} steady states, chunk={chunk}"
        times[name], found = timed(lambda grid=grid, chunk=chunk: sweep(actuator, *grid, chunk=chunk))
        numbers[name] = found.fundamental.values[::50].ravel().tolist()
    current = 0.1 + 0.6 * np.sin(2 * np.pi * np.arange(500) / 500)
    times["one steady state, 500 samples"], found = timed(lambda: simulate(actuator, current, 1 / 25_000, periodic=True))
    numbers["one steady state, 500 samples"] = np.asarray(found.displacement).tolist()
    recordings, start = one_draw(settled("gauss"), 0)
    bench = load_bench("aa-050h")
    fits = []
    for name in ("first", "second"):
        begin = time.perf_counter()
        fits.append(fit(recordings[: len(SINES)], bench, actuator=bench.actuator().replace(start)))
        times[f"joint fit of nine loops, the {name}"] = time.perf_counter() - begin
    numbers["joint fit of nine loops, the second"] = [float(e.value) for e in fits[-1].estimates if e.free]
    device = jax.devices()[0]
    return {"device": device.device_kind, "platform": device.platform, "cores": os.cpu_count(), "times": times, "numbers": numbers}


def main():
    """Both platforms, the table, the largest difference of each row relative to its largest number."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # this process only asks which there is
    import jax
    import numpy as np

    if jax.default_backend() == "cpu":
        raise SystemExit("tests.studies.gpu: this jax sees no GPU; install one that does, e.g. pip install 'jax[cuda13]'")
    found = {}
    for platform in ("cpu", jax.default_backend()):
        names = {"cpu": "cpu", "gpu": "cuda"}
        with tempfile.TemporaryDirectory() as cache:
            env = {**os.environ, "JAX_PLATFORMS": names.get(platform, platform), "MAGJAX_CACHE": cache, "OPENBLAS_NUM_THREADS": "1"}
            done = subprocess.run([sys.executable, "-m", "tests.studies.gpu", "one"], env=env, check=True, capture_output=True, text=True)
        found[platform] = json.loads(done.stdout.splitlines()[-1])
    here, there = found.values()
    rows = {}
    for name, seconds in here["times"].items():
        a, b = (np.asarray(side["numbers"].get(name, [0.0, 1.0])) for side in (here, there))
        rows[name] = {
            "processors, s": round(seconds, 4), "GPU, s": round(there["times"][name], 4), "ratio": round(seconds / there["times"][name], 2),
            "largest difference": float(np.max(np.abs(a - b) / np.max(np.abs(a)))),
        }  # fmt: skip
        print(f"{name:45s} {rows[name]}", flush=True)
    content = {"jax": jax.__version__, "cores": here["cores"], "GPU": there["device"], "rows": rows}
    HERE.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    print(json.dumps(one_platform())) if sys.argv[1:] == ["one"] else main()
