"""Double precision, one thread for the small dense solves, a compilation cache shared by the run's workers."""

import os
import signal
import tempfile
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background: what is interrupted here would not notice
    signal.signal(signal.SIGINT, signal.default_int_handler)
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):  # a compiler that does not know a flag ends the process
    # as the programs of fits have it (`magjax.programs.COMPILER`): half of the time to compile
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import jax
import pytest

from magjax.programs import forget

jax.config.update("jax_enable_x64", True)
# for the commands that tests start, too
cache = Path(os.environ.setdefault("MAGJAX_CACHE", str(Path(tempfile.gettempdir()) / "magjax-test-cache")))
cache.mkdir(parents=True, exist_ok=True)
jax.config.update("jax_compilation_cache_dir", str(cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


STRICT = {"test_fit", "test_preisach", "test_transients"}  # simulation, operator and fit: no rank is promoted by accident


LONGEST = ("test_diagnose", "test_blind_suite", "test_measured", "test_hum")  # first, so that no worker ends alone with one of them


def pytest_collection_modifyitems(items):
    """The longest modules first; no limit of time for long tests."""
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.timeout(0))
    last = len(LONGEST)  # in their order: programs of the first serve the next
    items.sort(key=lambda item: {name: k for k, name in enumerate(LONGEST)}.get(item.module.__name__.rpartition(".")[2], last))


@pytest.fixture(autouse=True, scope="module")
def ranks(request):
    """In the modules of STRICT arrays of unlike rank do not meet."""
    with jax.numpy_rank_promotion("raise" if request.module.__name__.rpartition(".")[2] in STRICT else "allow"):
        yield


HASTY = {"test_drift", "test_heat", "test_foretold", "test_hum", "test_columns", "test_effects", "test_learned", "test_passes", "test_shells", "test_simulate", "test_start_memory"}


@pytest.fixture(autouse=True, scope="module")
def hasty_compiler(request):
    """Modules whose programs run a few times and are compiled without optimizing: a third of their time. Where fits are made, not."""
    jax.config.update("jax_disable_most_optimizations", request.module.__name__.rpartition(".")[2] in HASTY)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(autouse=True, scope="module")
def release_programs():
    """Compiled programs of a module are dropped after it: each holds many memory mappings."""
    yield
    forget()
    jax.clear_caches()


@pytest.fixture(scope="session")
def measured():
    """The folder of measured recordings; tests skip where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"measured recordings are not at {DATA.name}/ beside the checkout")
    return DATA
