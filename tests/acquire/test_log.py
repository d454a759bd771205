"""The log: exact round trip, damage that costs only what it hits, resume, export, direct reading."""

import json
import os
import resource
import signal
import subprocess
import sys

import numpy as np
import pytest

from magjax.acquire import log as mjlog
from magjax.acquire.export import export_log
from magjax.errors import ConfigurationError, RecordingError
from magjax.recording import load_recordings

CHANNELS = [{"name": "current", "unit": "A", "scale": 1e-4}, {"name": "displacement", "unit": "um", "scale": 2e-3, "offset": 30.0}]
HEADER = {"device": "bench 1", "firmware": "1.0", "command_line": "magjax record x", "channels": CHANNELS, "bench": "aa-050h"}
PERIOD = 100


def samples(count, noise=3):
    k = np.arange(count)
    rng = np.random.default_rng(1)
    pair = [7000 * np.sin(2 * np.pi * k / PERIOD), 9000 * np.sin(2 * np.pi * k / PERIOD - 0.3) + noise * rng.standard_normal(count)]
    return np.round(np.stack(pair, axis=1)).astype("<i2")


def write(path, count=800, piece=50, skip=(), end=True):
    values = samples(count)
    writer = mjlog.LogWriter(path, HEADER)
    writer.event("start", segment=0, rate_Hz=5000.0, frequency_Hz=50.0)
    for k in range(0, count, piece):
        if k not in skip:
            writer.data(0, k, (200 * k, 200 * (k + piece - 1)), values[k : k + piece])
    if end:
        writer.end({"reason": "done"})
    writer.close()
    return values


def test_round_trip_and_direct_reading(tmp_path):
    path = tmp_path / "a.mjlog"
    values = write(path)
    ((table, metadata),) = mjlog.read_log(path)
    assert np.allclose(table["displacement_m"], (values[:, 1] * 2e-3 + 30) * 1e-6, rtol=1e-14)
    assert np.allclose(table["time_s"], np.arange(800) / 5000)
    assert metadata["device"] == "bench 1" and metadata["lost_samples"] == 0 and metadata["ended"] == "done"
    (recording,) = load_recordings([path], "aa-050h")
    assert recording.frequency() == pytest.approx(50, rel=1e-6) and recording.origin["metadata"]["device"] == "bench 1"


@pytest.mark.parametrize("suffix", [".nc", ".csv", ".mat", ".parquet"])
def test_export_carries_values_and_provenance(tmp_path, suffix):
    path = tmp_path / "a.mjlog"
    write(path)
    (target,) = export_log(path, tmp_path / f"a{suffix}")
    if suffix == ".parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        table = parquet.read_table(target)
        assert table.schema.metadata[b"device"] == b"bench 1" and table.num_rows == 800
        return
    (raw,), (exported,) = load_recordings([path], "aa-050h"), load_recordings([target], "aa-050h")
    for name, channel in raw.channels.items():
        assert np.allclose(channel, exported.channels[name], rtol=1e-9)
    if suffix != ".mat":
        assert len(exported.origin["metadata"]["log_sha256"]) == 64
    with pytest.raises(ConfigurationError, match="ending"):
        export_log(path, tmp_path / "a.xyz")
    with pytest.raises(ConfigurationError, match="cannot be written"):
        export_log(path, tmp_path / "absent" / f"a{suffix}")


def test_damage_costs_the_chunks_it_hits(tmp_path):
    path = tmp_path / "a.mjlog"
    values = write(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    header_end = next(at for at, kind, *_ in mjlog.chunks(whole) if kind == mjlog.EVENT)
    for _ in range(60):
        content = bytearray(whole)
        kind = rng.integers(3)
        at = int(rng.integers(header_end, len(whole) - 400))
        if kind == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at : at + 300] = bytes(300)
        else:
            content = content[:at]
        path.write_bytes(content)
        log = mjlog.Log(path)
        assert log.damage or kind == 2
        for _, first, _, _, counts in log.pieces:
            assert np.array_equal(counts, values[first : first + len(counts)])
        hit = {0: 1, 1: 3, 2: 16}[int(kind)]
        assert log.samples >= 800 - 50 * hit


def test_a_gap_shows_in_the_time_and_is_bridged_for_the_fit(tmp_path):
    path = tmp_path / "a.mjlog"
    write(path, piece=10, skip=(300, 310))
    ((table, metadata),) = mjlog.read_log(path)
    assert len(table["time_s"]) == 780 and metadata["lost_samples"] == 20 and np.diff(table["time_s"]).max() > 20 / 5000
    (recording,) = load_recordings([path], "aa-050h")
    assert recording.origin["metadata"]["bridged_samples"] == 20


def test_resume_cuts_a_torn_tail(tmp_path):
    path = tmp_path / "a.mjlog"
    values = write(path, end=False)
    with open(path, "ab") as stream:
        stream.write(b"MJL1 torn")
    with pytest.raises(ConfigurationError, match="--resume"):
        mjlog.LogWriter(path, HEADER)
    writer = mjlog.LogWriter(path, None)
    writer.event("resume")
    writer.event("start", segment=1, rate_Hz=5000.0)
    writer.data(1, 0, (0, 10), values[:100])
    writer.end({"reason": "done"})
    writer.close()
    log = mjlog.Log(path)
    assert not log.damage and log.missing == 0 and log.end["reason"] == "done"
    assert len(load_recordings([path], "aa-050h")) == 2
    (tmp_path / "text.mjlog").write_text("no log")
    with pytest.raises(RecordingError):
        mjlog.LogWriter(tmp_path / "text.mjlog", None)


def test_durable_acknowledges_after_the_sync(tmp_path):
    writer = mjlog.LogWriter(tmp_path / "a.mjlog", HEADER, durable=True)
    writer.data(0, 0, (0, 1), samples(100))
    assert writer.safe <= writer.written
    writer.close()
    assert writer.safe == writer.written == (tmp_path / "a.mjlog").stat().st_size


def test_a_full_disk_keeps_whole_chunks(tmp_path):
    code = f"""
import json, numpy as np
from magjax.acquire.log import DiskFull, LogWriter
writer = LogWriter({str(tmp_path / "full.mjlog")!r}, {HEADER!r})
writer.event("start", segment=0, rate_Hz=5000.0)
count = 0
try:
    while True:
        writer.data(0, count, (count, count), np.full((100, 2), 7, "<i2"))
        count += 100
except DiskFull as error:
    print(json.dumps([count, writer.written, error.exit_status]))
"""

    def limited():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    done = subprocess.run([sys.executable, "-c", code], preexec_fn=limited, capture_output=True, text=True, env={**os.environ})
    count, written, status = json.loads(done.stdout)
    log = mjlog.Log(tmp_path / "full.mjlog")
    assert log.samples == count > 0 and not log.damage and status == 6
    assert (tmp_path / "full.mjlog").stat().st_size == written


def test_a_damaged_start_is_told_by_the_counts_at_the_end(tmp_path):
    """Else the rate would be guessed and the transient read as if it were settled."""
    path = tmp_path / "a.mjlog"
    writer = mjlog.LogWriter(path, HEADER)
    about = {"segment": 0, "rate_Hz": 5000.0, "frequency_Hz": 50.0, "settle_samples": 200}
    writer.event("start", **about)
    writer.data(0, 0, (0, 100), samples(800))
    writer.event("counts", **about, received=800)
    writer.close()
    whole = path.read_bytes()
    ((table, metadata),) = mjlog.read_log(path)
    starts = [at for at, kind, *_ in mjlog.chunks(whole) if kind == mjlog.EVENT]
    content = bytearray(whole)
    content[starts[0] + 40] ^= 1
    path.write_bytes(content)
    ((damaged, about),) = mjlog.read_log(path)
    assert len(table["time_s"]) == 600 and np.array_equal(table["time_s"], damaged["time_s"]) and about["damaged_bytes"] > 0
    content[starts[1] + 40] ^= 1
    path.write_bytes(content)
    assert "transient is not cut off" in mjlog.read_log(path)[0][1]["start"]


@pytest.mark.parametrize("suffix", [".nc", ".csv", ".mat", ".parquet"])
def test_the_command_exports_a_log_with_its_provenance(tmp_path, suffix, capsys):
    from magjax.cli import main

    path, target = tmp_path / "a.mjlog", tmp_path / f"w\u00f6rk{suffix}"
    write(path)
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    assert main(["export", str(path), "--out", str(target)]) == 0
    again = tmp_path / f"again{'.csv' if suffix == '.nc' else suffix}"
    if suffix != ".parquet":
        assert main(["import", str(target), "--out", str(again)]) == 0
        assert load_recordings([again], "aa-050h")[0].n_samples == 800
    else:
        assert main(["export", str(path), "--out", str(tmp_path / "b.csv")]) == 0
        assert main(["import", str(tmp_path / "b.csv"), "--out", str(again)]) == 0 and again.exists()
    content = target.read_bytes()
    assert suffix == ".nc" or b"bench 1" in content
    assert not list(tmp_path.glob("*.part"))


def test_exports_that_cannot_be_are_one_line(tmp_path, capsys):
    from magjax.cli import main

    path = tmp_path / "a.mjlog"
    write(path)
    (tmp_path / "empty.mjlog").write_bytes(b"")
    (tmp_path / "torn.mjlog").write_bytes(path.read_bytes()[:50])
    (tmp_path / "folder.nc").mkdir()
    for source, out, status in (
        ("a.mjlog", "x.xyz", 2), ("a.mjlog", "folder.nc", 2), ("empty.mjlog", "x.nc", 3), ("torn.mjlog", "x.nc", 3), ("no.mjlog", "x.nc", 3),
    ):  # fmt: skip
        assert main(["export", str(tmp_path / source), "--out", str(tmp_path / out)]) == status, (source, out)
        text = capsys.readouterr().err
        assert text.count("\n") == 1 and source.split(".")[0] in text or out in text
    assert not (tmp_path / "x.nc").exists()
