"""What runs inside a worker: JAX set up as in the process that asked, inputs unpickled once, a chunk at a time.

BLAS gets one thread: it sums in another order with every number of threads, and workers would crowd each other's cores;
XLA's own threads leave the sums alone. JAX must be in double precision before the inputs are unpickled: arrays would
lose half their digits on the way in.
"""

import os
import pickle
import signal
import sys
import threading
import uuid
import zlib

import threadpoolctl

BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_default_matmul_precision",
    "jax_platforms",
)
_TOKEN = uuid.uuid4().hex
_opened: dict[str, object] = {}  # digest -> inputs of the job at hand; one at a time
_guard = threading.Lock()


def settings() -> dict:
    """JAX settings of this process that a worker takes over; {} where JAX is not in use."""
    if "jax" not in sys.modules:
        return {}
    import jax

    return {name: getattr(jax.config, name) for name in SETTINGS}


def take_over(found: dict) -> None:
    """Apply another process's settings: by the environment where JAX is not imported yet (work may do without it)."""
    if "jax" not in sys.modules:
        os.environ.update({name.upper(): str(value) for name, value in found.items() if value is not None})
        return
    import jax

    for name, value in found.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)


def one_thread():
    """One thread for the BLAS libraries of this process: from the call on, or as a context."""
    return threadpoolctl.threadpool_limits(1, user_api="blas")


def settle_in(found: dict) -> None:
    """Make this process a worker for good: settings taken over, one thread for BLAS, be it loaded already or later."""
    take_over(found)
    os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))
    one_thread()


def pack(inputs) -> bytes:
    """Inputs with the settings that they need, and the process that packed them; compressed (bases are mostly zeros)."""
    return pickle.dumps((_home(), settings(), zlib.compress(pickle.dumps(inputs), 1)))


def _home():
    """This process among all."""
    return _TOKEN, os.getpid()


def open_inputs(name: str, blob: bytes):
    """The inputs of a job, unpickled when first asked for; `name`: digest of the blob."""
    with _guard:
        if name not in _opened:
            home, found, content = pickle.loads(blob)
            if home != _home():  # else a thread of the process that asked, which keeps its own settings
                settle_in(found)
            _opened.clear()
            _opened[name] = pickle.loads(zlib.decompress(content))
        return _opened[name]


def perform_packed(work, name: str, blob: bytes, item, entropy):
    """One chunk with packed inputs: for engines whose workers serve many jobs."""
    from .job import perform

    return perform(work, open_inputs(name, blob), item, entropy)


def begin(name: str, blob: bytes) -> int:
    """First call in a process of our own pool; returns its process id.

    Ctrl-C is the parent's to handle. A parent that was killed cannot tell its workers: they watch it and leave.
    """
    import multiprocessing

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    open_inputs(name, blob)
    return os.getpid()


def _leave_with(parent):
    parent.join()
    os._exit(1)


def perform_opened(work, name: str, item, entropy):
    """One chunk in a process of our own pool, whose inputs are there already."""
    from .job import perform

    return perform(work, _opened[name], item, entropy)
