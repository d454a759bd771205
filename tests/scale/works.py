"""Work for the tests of jobs: functions of a module, so that workers can import them."""

import os
import signal
import time
from pathlib import Path

import numpy as np


def spectrum(inputs, item, rng):
    """Numbers that depend on the inputs, the item and the random numbers."""
    noise = rng.standard_normal(50)
    return {"item": item, "lines": np.abs(np.fft.rfft(inputs["signal"] + noise)), "mean": float(noise.mean()), "worker": None}


def nothing(inputs, item, rng):
    """An empty chunk."""
    return {}


def named(inputs, item, rng):
    """As `spectrum`, with the number of the process."""
    return {**spectrum(inputs, item, rng), "worker": os.getpid()}


def counted(inputs, item, rng):
    """As `spectrum`, leaving a trace of each run in a folder."""
    with open(Path(inputs["folder"]) / "ran.txt", "a") as trace:
        trace.write(f"{item} {os.getpid()}\n")
    time.sleep(inputs.get("seconds", 0.0))
    return spectrum(inputs, item, rng)


def fatal_once(inputs, item, rng):
    """The first worker that takes item 3 is killed by -9."""
    flag = Path(inputs["folder"]) / "died"
    if item == 3 and not flag.exists():
        flag.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return counted(inputs, item, rng)


def fatal(inputs, item, rng):
    """Item 2 kills every worker."""
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return spectrum(inputs, item, rng)


def refusing(inputs, item, rng):
    """Item 2 raises."""
    if item == 2:
        raise ValueError("item 2 cannot be done")
    return spectrum(inputs, item, rng)


def precision(inputs, item, rng):
    """What JAX is set to in the worker."""
    import jax

    least = jax.config.jax_persistent_cache_min_compile_time_secs
    return {"dtype": str(jax.numpy.asarray(0.1).dtype), "cache": jax.config.jax_compilation_cache_dir, "least": least}


def products(inputs, item, rng):
    """Sums that BLAS splits over its threads."""
    a = rng.standard_normal((900, 500))
    return {"product": a.T @ a, "inverse": np.linalg.inv(a[:500])}


def threads(inputs, item, rng):
    """Threads of BLAS while a chunk is at work."""
    import threadpoolctl

    time.sleep(0.02 * item)
    return {"threads": [p["num_threads"] for p in threadpoolctl.threadpool_info() if p["user_api"] == "blas"]}
