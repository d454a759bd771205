"""Jobs: the same numbers whoever works, kill -9 of a worker and of the whole job, torn and damaged checkpoints."""

import concurrent.futures
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from magjax.bench import load_bench
from magjax.errors import ConfigurationError
from magjax.scale import Chunk, Job, run_job
from magjax.scale.checkpoint import Checkpoint
from magjax.scale.codec import decode, digest, encode
from tests.scale import works

ROOT = Path(__file__).resolve().parents[2]


def job(work=works.spectrum, count=8, seed=5, name="test", **inputs):
    chunks = tuple(Chunk(f"item {k}", k) for k in range(count))
    return Job(name, work, {"signal": np.sin(np.arange(50.0)), **inputs}, chunks, seed)


def same(a, b):
    """Equal to the last bit."""
    return json.dumps(encode(a)) == json.dumps(encode(b))


@pytest.fixture(scope="module")
def plain():
    return run_job(job()).results


def test_chunks_have_their_own_random_numbers(plain):
    means = [r["mean"] for r in plain]
    assert len(set(means)) == len(means)
    assert same(plain, run_job(job()).results)
    assert not same(plain, run_job(job(seed=6)).results)
    # a chunk's numbers do not depend on which others there are
    assert same(plain[:3], run_job(job(count=3)).results)


def test_processes_give_the_same_numbers(plain):
    assert same(plain, run_job(job(), "processes:2").results)


def test_an_executor_of_the_caller(plain):
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        assert same(plain, run_job(job(), pool).results)


@pytest.mark.parametrize("wrong", ["processes", "processes:0", "threads:2", "dask:", 7])
def test_wrong_executors_are_named(wrong):
    with pytest.raises(ConfigurationError, match="processes:N"):
        run_job(job(), wrong)


def test_two_chunks_of_one_name():
    with pytest.raises(ConfigurationError, match="its own id"):
        Job("twins", works.spectrum, {}, (Chunk("a", 1), Chunk("a", 2)))


def test_a_killed_worker_costs_its_chunk_only(plain, tmp_path):
    outcome = run_job(job(works.fatal_once, folder=str(tmp_path)), "processes:2")
    assert same(plain, outcome.results) and outcome.lost == 1
    ran = [line.split()[0] for line in (tmp_path / "ran.txt").read_text().splitlines()]
    assert sorted(ran) == sorted(map(str, range(8)))  # none ran twice
    assert "1 worker lost" in str(outcome)


def test_a_chunk_that_kills_every_worker_is_given_up(tmp_path):
    with pytest.raises(ConfigurationError, match="item 2 ended its worker 3 times"):
        run_job(job(works.fatal, count=4), "processes:1", checkpoint=tmp_path / "job")
    # the rest was kept
    mended = run_job(job(works.fatal, count=2), checkpoint=tmp_path / "job")
    assert mended.resumed == 2


def test_a_worker_killed_between_two_chunks_costs_none(plain):
    """The consumer holds the engine at a result: its worker is idle then."""
    from magjax.scale.engines import Processes

    engine, one = Processes(1), job(works.named)
    tasks = [(c.id, c.item, one.entropy(c)) for c in one.chunks]
    found = {}
    for chunk, result in engine.run("test", one.work, one.inputs, tasks):
        if chunk == "item 3":
            os.kill(result["worker"], signal.SIGKILL)
            while alive(result["worker"]):
                time.sleep(0.05)
            time.sleep(0.5)  # until the pool has noticed
        found[chunk] = {**result, "worker": None}
    assert engine.lost == 1 and same([decode(found[c.id]) for c in one.chunks], plain)


@pytest.mark.parametrize("executor", ["processes:2", None])
def test_a_job_left_early_leaves_no_worker(tmp_path, executor):
    def stop(text, done, _):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_job(job(works.counted, folder=str(tmp_path), seconds=0.2), executor, progress=stop)
    workers = {int(line.split()[1]) for line in (tmp_path / "ran.txt").read_text().splitlines()} - {os.getpid()}
    limit = time.time() + 10
    while any(map(alive, workers)) and time.time() < limit:
        time.sleep(0.05)
    assert not any(map(alive, workers))


@pytest.mark.parametrize("executor", [None, "processes:1"])
def test_an_error_of_the_work_comes_through(tmp_path, executor):
    with pytest.raises(ValueError, match="item 2 cannot"):
        run_job(job(works.refusing), executor, checkpoint=tmp_path / "job")
    assert run_job(job(works.refusing, count=2), checkpoint=tmp_path / "job").resumed == 2


SCRIPT = """
import sys, numpy as np
from magjax.scale import run_job
from tests.scale import works
from tests.scale.test_jobs import job
if __name__ == "__main__":
    run_job(job(works.counted, folder=sys.argv[1], seconds=0.25), sys.argv[2] if sys.argv[2] != "None" else None, checkpoint=sys.argv[1] + "/job")
"""


@pytest.mark.parametrize("executor", ["None", "processes:2"])
def test_kill_of_the_whole_job_and_resume(plain, tmp_path, executor):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen([sys.executable, str(script), str(tmp_path), executor], env={**os.environ, "PYTHONPATH": str(ROOT)})
    checkpoint = tmp_path / "job"
    limit = time.time() + 60
    while time.time() < limit and (not checkpoint.exists() or checkpoint.read_bytes().count(b"\n") < 4):
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    workers = {int(line.split()[1]) for line in (tmp_path / "ran.txt").read_text().splitlines()} - {process.pid}
    finished = checkpoint.read_bytes().count(b"\n") - 1
    assert 3 <= finished < 8
    resumed = run_job(job(works.counted, folder=str(tmp_path), seconds=0.25), checkpoint=checkpoint)
    assert resumed.resumed >= finished and same(plain, resumed.results)
    # nothing is left of the killed job
    limit = time.time() + 10
    while any(map(alive, workers)) and time.time() < limit:
        time.sleep(0.1)
    assert not any(map(alive, workers))


def alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("cut", [1, 7, 40])
def test_a_torn_last_line_is_cut_off(plain, tmp_path, cut):
    path = tmp_path / "job"
    run_job(job(), checkpoint=path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    again = run_job(job(), checkpoint=path)
    assert again.resumed == 7 and same(plain, again.results)
    assert path.read_bytes() == whole


def test_a_torn_first_line_begins_anew(plain, tmp_path):
    path = tmp_path / "job"
    run_job(job(), checkpoint=path)
    for cut in (3, 12, 60):
        path.write_bytes(path.read_bytes()[:cut])
        assert run_job(job(), checkpoint=path).resumed == 0


def test_a_damaged_line_costs_its_chunk(plain, tmp_path):
    path = tmp_path / "job"
    run_job(job(), checkpoint=path)
    content = bytearray(path.read_bytes())
    third = content.index(b"\n", content.index(b"\n") + 1) + 30
    content[third] ^= 1
    path.write_bytes(content)
    again = run_job(job(), checkpoint=path)
    assert again.resumed == 7 and same(plain, again.results)
    assert run_job(job(), checkpoint=path).resumed == 8


def test_a_longer_job_takes_what_is_there(plain, tmp_path):
    path = tmp_path / "job"
    run_job(job(count=5), checkpoint=path)
    longer = run_job(job(count=8), "processes:2", checkpoint=path)
    assert longer.resumed == 5 and same(plain, longer.results)


def test_a_checkpoint_of_another_job_is_refused(tmp_path):
    path = tmp_path / "job"
    run_job(job(), checkpoint=path)
    kept = path.read_bytes()
    for other in (job(seed=6), job(works.refusing), job(name="other"), job(extra=1.0)):
        with pytest.raises(ConfigurationError, match="another job"):
            run_job(other, checkpoint=path)
    path.write_text("time_s,current_A\n0,1\n")
    with pytest.raises(ConfigurationError, match="not a checkpoint"):
        run_job(job(), checkpoint=path)
    path.write_text("0,1")  # a lone line without an end is no header of ours either
    with pytest.raises(ConfigurationError, match="not a checkpoint"):
        run_job(job(), checkpoint=path)
    assert path.read_text() == "0,1"
    with pytest.raises(ConfigurationError, match="cannot be written"):
        run_job(job(), checkpoint=tmp_path)
    assert b"another" not in kept


def test_one_job_at_a_time(tmp_path):
    with Checkpoint(tmp_path / "job", {"job": "a"}), pytest.raises(ConfigurationError, match="another job is writing"):
        Checkpoint(tmp_path / "job", {"job": "a"})


def test_results_lose_no_bit():
    rng = np.random.default_rng(0)
    value = {
        "a": rng.standard_normal((3, 4)), "b": [1, 2.5, None, "text", True, float("inf"), -0.0, 1e-310, 0.1 + 0.2], "c": np.asarray(3.5),
        "d": rng.standard_normal(2) + 1j, "e": np.zeros((0, 2), np.int32), "f": np.float64(0.1), "g": {"h": (1, 2)},
    }  # fmt: skip
    back = decode(json.loads(json.dumps(encode(value))))
    assert same(value, back) and back["c"].shape == () and back["e"].shape == (0, 2) and back["d"].dtype == complex
    assert np.isnan(decode(json.loads(json.dumps(encode(float("nan"))))))
    with pytest.raises(TypeError, match="not set"):
        encode({1, 2})


@pytest.mark.parametrize("executor", [None, "processes:1"])
def test_workers_take_over_the_settings_of_jax(executor):
    found = run_job(job(works.precision, count=1), executor).results[0]
    import jax

    here = {"cache": jax.config.jax_compilation_cache_dir, "least": jax.config.jax_persistent_cache_min_compile_time_secs}
    assert found == {"dtype": "float64", **here} and here["cache"]


THREADS = """
import sys
from magjax.scale import run_job
from magjax.scale.codec import digest
from tests.scale import works
from tests.scale.test_jobs import job
print(digest(run_job(job(works.products, count=1)).results))
"""


def test_the_numbers_do_not_depend_on_the_threads_of_blas():
    run = {"capture_output": True, "text": True, "cwd": ROOT, "check": True}
    ended = [
        subprocess.run([sys.executable, "-c", THREADS], env={**os.environ, "OPENBLAS_NUM_THREADS": n}, **run).stdout for n in "12"
    ]
    assert ended[0] == ended[1] and len(ended[0]) > 30


def test_blas_has_its_threads_again_after_a_job():
    import threadpoolctl

    def threads():
        return [p["num_threads"] for p in threadpoolctl.threadpool_info() if p["user_api"] == "blas"]

    before = threadpoolctl.threadpool_limits(2, user_api="blas")
    try:
        with concurrent.futures.ThreadPoolExecutor(3) as pool:
            inside = [r["threads"] for r in run_job(job(works.threads, count=6), pool).results]
        assert set(threads()) == {2}
    finally:
        before.restore_original_limits()
    assert all(set(row) == {1} for row in inside)


def test_digests_tell_contents_apart():
    actuator = load_bench("aa-050h").actuator()
    assert digest(actuator) == digest(load_bench("aa-050h").actuator())
    assert digest(actuator) != digest(actuator.replace({"coil.R_eddy": 70.0 * (1 + 1e-15)}))
    different = [
        1,
        1.0,
        "1",
        True,
        [1],
        {"1": 1},
        None,
        b"1",
        np.ones(1),
        np.ones((1, 1)),
        [[1], []],
        [[], [1]],
        works.spectrum,
        works.fatal,
    ]
    assert len({digest(v) for v in different}) == len(different)
    code = "from magjax.bench import load_bench; from magjax.scale.codec import digest; import jax; jax.config.update('jax_enable_x64', True); print(digest(load_bench('aa-050h').actuator()))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert out.strip() == digest(actuator)
