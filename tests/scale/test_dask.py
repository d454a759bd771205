"""dask.distributed as the engine: the same numbers by address and by client, a killed worker, no scheduler."""

import json

import pytest

from magjax.errors import ConfigurationError
from magjax.scale import run_job
from magjax.scale.codec import encode
from tests.scale import works
from tests.scale.test_jobs import job

distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
pytestmark = pytest.mark.filterwarnings("ignore")  # a cluster with a killed worker leaves sockets behind


@pytest.fixture(scope="module")
def cluster():
    import dask

    # dask gives a chunk up at the first death: what is tried again is tried by the job (restarts take seconds)
    settings = dask.config.set({"distributed.scheduler.allowed-failures": 0})
    with settings, distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made:
        yield made


def test_by_address_and_by_client(cluster):
    plain = json.dumps(encode(run_job(job()).results))
    assert json.dumps(encode(run_job(job(), f"dask:{cluster.scheduler_address}").results)) == plain
    with distributed.Client(cluster) as client:
        assert json.dumps(encode(run_job(job(), client).results)) == plain
        with pytest.raises(ValueError, match="item 2 cannot"):
            run_job(job(works.refusing), client)


@pytest.mark.long
def test_a_killed_worker_is_replaced(cluster, tmp_path):
    outcome = run_job(job(works.fatal_once, folder=str(tmp_path)), f"dask:{cluster.scheduler_address}", checkpoint=tmp_path / "job")
    assert (tmp_path / "died").exists()
    assert json.dumps(encode(outcome.results)) == json.dumps(encode(run_job(job()).results))


def test_a_chunk_that_kills_every_worker_is_given_up(cluster):
    with pytest.raises(ConfigurationError, match="ended every dask worker"):
        run_job(job(works.fatal, count=3), f"dask:{cluster.scheduler_address}")


def test_no_scheduler_there(monkeypatch):
    monkeypatch.setattr("magjax.scale.engines.PATIENCE", 0.5)
    with pytest.raises(ConfigurationError, match="no dask scheduler answers"):
        run_job(job(), "dask:tcp://127.0.0.1:9")


def test_the_blind_suite_over_a_cluster(cluster, tmp_path):
    """Cases that are done already: the cluster finds their results and runs none."""
    from tests.blind.cases import make_case
    from tests.blind.run import run_cases

    rows = []
    for number in (0, 2):
        folder = tmp_path / make_case("dev", number).name
        folder.mkdir()
        rows.append({"name": folder.name, "status": 0, "seconds": 61.5})
        (folder / "done.json").write_text(json.dumps(rows[-1]))
    assert run_cases("dev", (0, 2), tmp_path, f"dask:{cluster.scheduler_address}").results == rows
