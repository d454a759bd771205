"""The commands ports, emulate, record: speed, exact counts at line speed, other adapters, bad input in one line."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import tty

import numpy as np
import pytest
from conftest import verify

from magjax.acquire import protocol as p
from magjax.acquire.adapters import ScpiAmplifier, TextAdapter
from magjax.acquire.framing import encode
from magjax.acquire.link import ask_hello, open_port
from magjax.acquire.log import Log
from magjax.acquire.order import Order, commanded
from magjax.acquire.process import record
from magjax.acquire.recorder import Ended, Recorder
from magjax.cli import main
from magjax.errors import ConfigurationError, DeviceError
from magjax.recording import load_recordings

QUICK = {"boot_wait_s": 30.0, "start_wait_s": 30.0, "give_up_s": 30.0}


def magjax(*arguments):
    command = [sys.executable, "-m", "magjax", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})


def rate_of(path):
    log = Log(path)
    begin = next(e["host_time"] for e in log.events if e["event"] == "start")
    end = next(e["host_time"] for e in log.events if e["event"] == "counts")
    return log.samples / (end - begin)


def throughput(emulate, order, samples, again=0):
    made = order(emulate("--fast", "--frame", "256")["port"], samples=samples)
    made.path += f".{again}.mjlog"
    end = record(made)
    assert end["lost"] == 0 and end["received"] == samples
    verify(made.path)
    return rate_of(made.path)


def test_a_pty_is_read_fast(emulate, order):
    # both processes share two cores with whatever else runs; the full rate is asked of the long test
    assert any(throughput(emulate, order, 1_000_000, k) > 3e5 for k in range(4))


@pytest.mark.long
def test_a_million_samples_a_second(emulate, order, record_property):
    rate = throughput(emulate, order, 10_000_000)
    record_property("samples_per_second", rate)
    print(f"{rate:.4g} samples/s of two channels")
    assert rate > 1e6


def paced(emulate, order, seconds, again=0):
    made = order(emulate("--baud", "2000000")["port"], rate=40e3, samples=int(40e3 * seconds))
    made.path += f".{again}.mjlog"
    end = record(made)
    assert end["received"] + end["lost"] == end["sent"] == 40e3 * seconds
    verify(made.path)
    return end


def test_losses_at_two_megabaud_are_counted(emulate, order):
    ends = (paced(emulate, order, 2, k) for k in range(4))  # counted exactly each time; few where the machine is not busy
    assert any(end["lost"] < 0.05 * end["sent"] for end in ends)


@pytest.mark.long
def test_no_loss_at_two_megabaud(emulate, order):
    assert any(paced(emulate, order, 30, k)["lost"] == 0 for k in range(3))  # where the machine is otherwise idle, the first


def test_record_and_fit_what_it_wrote(emulate, tmp_path):
    port = emulate("--fast", "--fault", "drift=100")["port"]
    log, table = tmp_path / "a.mjlog", tmp_path / "a.nc"
    done = magjax(
        "record",
        port,
        "--frequency",
        "50",
        "--amplitude",
        "0.4",
        "--offset",
        "0.1",
        "--out",
        str(log),
        "--export",
        str(table),
        "--json",
    )
    assert done.returncode == 0, done.stderr
    end = json.loads(done.stdout)
    assert end["lost"] == 0 and end["received"] == 12 * 500 and end["exported"] == [str(table)]
    for path in (log, table):
        (recording,) = load_recordings([path], "aa-050h")
        about = recording.origin["metadata"]
        assert recording.frequency() == pytest.approx(50) and recording.n_samples == 8 * 500
        assert (
            about["device"] == "emulated plain 0"
            and about["command_line"].startswith("magjax record ")
            and about["current"] == "measured"
        )
    import xarray as xr

    with xr.open_dataset(table, engine="h5netcdf") as data:
        assert np.abs(data.command.values - data.current.values).max() < 1e-12


def test_the_command_is_what_the_device_played():
    about = {"scale": 5e-5, "repeats": 3, "samples": 40, "amplitude": 9000, "offset": -100, "factor": 0.5}
    played = commanded(about, np.arange(160))
    assert played[10] == pytest.approx((9000 * 0.5**0.25 - 100) * 5e-5, abs=2.6e-5) and np.all(played[120:] == 0)
    table = Order("x", "y", drive={"kind": "table", "values": [0.1, 0.2], "repeats": 0})
    table.scale = 5e-5
    assert np.allclose(commanded(table.command()["command"], np.arange(3)), [0.1, 0.2, 0.1])


class FakeDevice(threading.Thread):
    """The far end of a pseudo-terminal: `answer(chunk)` gives what to send back."""

    def __init__(self, answer, first=b""):
        super().__init__(daemon=True)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.name_of_port = os.ttyname(self.slave)
        os.close(self.slave)
        self.answer, self.heard, self.first = answer, b"", first
        self.closing = False
        self.start()

    def run(self):
        import select
        import time

        while not self.closing:
            if not select.select([self.master], [], [], 0.05)[0]:
                continue
            try:
                chunk = os.read(self.master, 4096)
            except OSError:
                time.sleep(0.01)
                continue
            self.heard += chunk
            reply = self.answer(chunk)
            if reply:
                os.write(self.master, reply)

    def end(self):
        self.closing = True
        self.join()
        os.close(self.master)


def test_text_lines():
    adapter = TextAdapter()
    assert adapter.feed(b"noise before\n# seq,t_us,current_mA,displacement_um\n7,100,1.5,2") == []
    messages = adapter.feed(b".5\n8,200,2,3\nbroken,line\n9,300,4\n10,400,1,nan\n11,500,5,6\n")
    frames = [f for _, f in messages]
    assert [(f.seq, f.time_us, f.counts.tolist()) for f in frames] == [(7, 100, [[1.5, 2.5], [2.0, 3.0]]), (11, 500, [[5.0, 6.0]])]
    assert adapter.damaged == 3 and adapter.hello.channels[0].to_si(adapter.feed(b"12,0,2000,0\n")[0][1].counts[:, 0])[0] == 2.0
    with pytest.raises(DeviceError, match="colour"):
        TextAdapter("seq,t_us,colour_A")
    assert adapter.feed(b"# warm, ready\n# seq,t_us,current_mA,displacement_um\n") == []
    with pytest.raises(DeviceError, match="columns are now"):
        adapter.feed(b"# seq,t_us,displacement_um,current_mA\n")


def test_a_text_line_device_is_recorded(tmp_path):
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    name = os.ttyname(slave)
    os.close(slave)
    stop = threading.Event()

    def print_lines():
        k = 0
        while not stop.wait(0.005):
            rows = b"".join(
                f"{j},{j * 100},{500 * np.sin(j / 20):.3f},{50 + 10 * np.sin(j / 20):.3f}\n".encode()
                for j in range(k, k + 50)
                if j % 997
            )
            with contextlib.suppress(BlockingIOError):  # nobody reads any more
                os.write(master, (b"# seq,t_us,current_mA,displacement_um\n" if k % 1000 == 0 else b"") + rows)
            k += 50

    writer = threading.Thread(target=print_lines, daemon=True)
    writer.start()
    try:
        end = record(Order(name, str(tmp_path / "t.mjlog"), rate=0.0, text="", max_s=1.5, **QUICK))
    finally:
        stop.set()
        writer.join()
        os.close(master)
    assert end["status"] == 0 and end["received"] > 1000 and not end["tail_known"], end
    assert end["drive_at_zero"] == "not driven by magjax"
    (recording,) = load_recordings([tmp_path / "t.mjlog"], "aa-050h")
    assert recording.dt == pytest.approx(1e-4, rel=1e-3) and recording.channels["current"].max() == pytest.approx(0.5, rel=1e-3)


def test_a_scpi_amplifier_is_set_up_and_switched_off(emulate, order):
    def kepco(chunk):
        return b"KEPCO,BOP 20-20,1,1\n" * chunk.count(b"*IDN?") + b'0,"No error"\n' * chunk.count(b"SYST:ERR?")

    far = FakeDevice(kepco)
    made = order(emulate("--fast")["port"], amplifier=far.name_of_port, limit_A=0.6)
    end = record(made)
    far.end()
    assert end["status"] == 0, end
    said = far.heard.decode().split("\n")
    assert said.index("FUNC:MODE CURR") < said.index("CURR 0") < said.index("OUTP ON") < said.index("OUTP OFF")
    assert next(e for e in Log(made.path).events if e["event"] == "amplifier")["identity"].startswith("KEPCO")
    deaf = FakeDevice(lambda chunk: b"")
    amplifier = ScpiAmplifier(deaf.name_of_port, 1.0)
    with pytest.raises(DeviceError, match="does not answer"):
        amplifier.ask("*IDN?", 0.2)
    with pytest.raises(ConfigurationError, match="beyond the limit"):
        amplifier.level(2.0)
    amplifier.port.close()
    deaf.end()


HELLO = {
    "protocol": 1, "device": "d", "firmware": "1", "boot_id": "a", "rate_max_Hz": 1e6, "frame_samples": 8, "drive": None,
    "channels": [{"name": "current", "unit": "A", "scale": 1e-4}],
}  # fmt: skip


@pytest.mark.parametrize(
    ("hello", "words"),
    [
        (p.hello_packet({**HELLO, "protocol": 9}), "protocol version 9"),
        (bytes((p.HELLO, 3)) + b"{}", "protocol version 3"),
        (p.hello_packet({**HELLO, "channels": [{"name": "current", "unit": "banana", "scale": 1}]}), "banana"),
        (p.hello_packet(HELLO), "no drive output"),
        (b"", "no HELLO"),
    ],
)
def test_a_foreign_device_is_one_line_and_status_5(tmp_path, hello, words):
    far = FakeDevice(lambda chunk: encode(hello) if hello else b"garbage")
    end = record(
        Order(
            far.name_of_port,
            str(tmp_path / "a.mjlog"),
            drive={"kind": "table", "values": [0.1] * 9, "repeats": 0},
            boot_wait_s=30.0 if hello else 1.0,
        )
    )
    far.end()
    assert end["status"] == 5 and words in end["reason"] and "\n" not in end["reason"]
    assert not (tmp_path / "a.mjlog").exists()


def test_a_measured_current_beyond_the_limit_ends_it(tmp_path):
    recorder = Recorder(Order("x", str(tmp_path / "a.mjlog"), limit_A=0.5), lambda state: None)
    recorder.hello = p.read_hello(p.hello_packet(HELLO))
    recorder._guard(np.array([[5400], [-5400]], "<i2"))
    with pytest.raises(Ended, match="0.56 A where the limit is 0.5 A") as caught:
        recorder._guard(np.array([[100], [-5600]], "<i2"))
    assert caught.value.status == 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--amplitude", "nan"], "amplitude and offset in A"),
        (["--offset", "inf"], "amplitude and offset in A"),
        (["--limit", "nan"], "--limit = nan"),
        (["--limit", "0"], "--limit = 0"),
        (["--limit", "-1"], "--limit = -1"),
        (["--frequency", "nan"], "--frequency above zero"),
        (["--frequency", "inf"], "--rate = inf"),
        (["--no-drive", "--rate", "nan"], "--rate = nan"),
        (["--no-drive", "--rate", "0"], "--rate = 0"),
        (["--no-drive", "--rate", "-5"], "--rate = -5"),
        (["--seconds", "-1"], "--seconds = -1"),
        (["--seconds", "nan"], "--seconds = nan"),
        (["--give-up", "nan"], "--give-up = nan"),
        (["--baud", "0"], "--baud = 0"),
        (["--export", "absent/a.nc"], "folder absent does not exist"),
        (["--export", "a.xyz"], "ending .xyz"),
        (["--out", "a.csv"], "write a.mjlog"),
        (["--out", "."], "is a folder"),
        (["--out", "there.mjlog"], "exists already"),
        (["--plan", "p.toml", "--export", "a.nc"], "--export does nothing beside --plan"),
        (["--plan", "p.toml", "--no-drive"], "--no-drive does nothing beside --plan"),
    ],
)
def test_wrong_words_are_refused_before_the_port_is_touched(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mjlog").write_bytes(b"x")
    out = [] if "--out" in arguments else ["--out", "a.mjlog"]
    assert main(["record", "/dev/ttyNONE", *out, *arguments]) == 2
    text = capsys.readouterr().err
    assert words in text and text.count("\n") == 1
    assert [f.name for f in tmp_path.iterdir()] == ["there.mjlog"]


def test_acquisition_needs_no_jax():
    code = (
        "import sys, magjax.acquire.process, magjax.acquire.emulator, magjax.acquire.investigation; assert 'jax' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_bad_input_is_one_line(emulate, tmp_path, capsys):
    out = str(tmp_path / "a.mjlog")
    port = emulate("--fast")["port"]
    cases = [
        (["/dev/ttyNONE", "--out", out], 5, "no such port"),
        ([port, "--out", str(tmp_path / "absent" / "a.mjlog")], 2, "does not exist"),
        ([port, "--out", out, "--amplitude", "2"], 2, "limit is 0.9 A"),
        ([port, "--out", out, "--samples", "20000"], 2, "samples/s"),
        ([port, "--out", out, "--resume"], 2, "no such log"),
        ([port, "--out", out, "--export", str(tmp_path / "a.xyz")], 2, ".parquet"),
        (["socket://127.0.0.1:9", "--out", out], 5, "nothing listens"),
    ]
    for arguments, status, words in cases:
        done = magjax("record", *arguments)
        assert done.returncode == status, (arguments, done.stderr)
        assert words in done.stderr and len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr
    device = open_port(port)
    assert ask_hello(device, 20.0).content["drive_now"] == 0 and not list(tmp_path.glob("*.mjlog"))
    device.close()
    with open(port):
        done = magjax("record", port, "--out", str(tmp_path / "b.mjlog"))
        assert done.returncode == 5 and "in use by process" in done.stderr
    (tmp_path / "tty").write_text("a file of the user's")
    for arguments in (
        ["--fault", "drop=2"],
        ["--frame", "0"],
        ["--rate-max", "nan"],
        ["--baud", "0"],
        ["--watchdog", "-1"],
        ["--hide", "sensor_lag:tau=-1"],
        ["--hide", "sensor_lag:tau=nan"],
        ["--fault", "flood=3"],
        ["--hide", "gremlin"],
        ["--hide", "sensor_lag:tau=much"],
        ["--bench", "plain", "--hide", "sensor_lag"],
    ):
        assert main(["emulate", "--as-stated", *arguments]) == 2, arguments
        assert capsys.readouterr().err.count("\n") == 1
    for arguments in (["--tcp", "99999"], ["--link", str(tmp_path / "tty")], ["--link", str(tmp_path / "absent" / "tty")]):
        assert main(["emulate", "--bench", "plain", *arguments]) == 5, arguments
        assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "tty").read_text() == "a file of the user's"
    assert main(["ports", "--json"]) == 0
    json.loads(capsys.readouterr().out)


def test_of_two_recorders_on_one_port_one_records(emulate, tmp_path):
    port = emulate()["port"]
    command = [sys.executable, "-m", "magjax", "record", port, "--frequency", "10", "--quiet", "--out"]
    both = [subprocess.Popen([*command, str(tmp_path / f"{k}.mjlog")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for k in range(2)]  # fmt: skip
    said = sorted((child.communicate(timeout=120), child.returncode)[::-1] for child in both)
    if said[1][0] == 0:  # so slow a start of the second that the first was done
        return
    assert [status for status, _ in said] == [0, 5] and "in use by" in said[1][1][1]
    (log,) = [Log(path) for path in tmp_path.glob("*.mjlog")]
    assert log.end["lost"] == 0 and log.samples == 6000
