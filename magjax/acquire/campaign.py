"""A campaign: the drives of a study file, one log each, demagnetized before, checked after, a bad one repeated.

    samples = 500          # a period                  periods = 8       # kept, settled
    settle = 4             # periods before them       demagnetize = true
    tries = 3              # of a recording that fails its check
    [[drives]]
    kind = "sine"          # frequency x amplitude x offset, lists or numbers (Hz, A)
    frequency = [10, 50, 200]
    amplitude = [0.5, 0.8]
    offset = 0.1
Other kinds: multisine (frequency list, amplitude, offset), minor_loops (carrier, modulation, amplitude, depth, offset), decaying
(frequency, amplitude, offset, decay), reversal_curves (low, high, count, rate).
"""

import dataclasses
import glob
import hashlib
import json
import tomllib
from pathlib import Path

import numpy as np

from .. import waveforms
from ..errors import ConfigurationError, MagjaxError
from .export import export_log
from .link import ask_hello, open_port
from .log import Log
from .order import Order
from .process import record

KEYS = {
    "sine": ("frequency", "amplitude", "offset"),
    "multisine": ("frequency", "amplitude", "offset"),
    "minor_loops": ("carrier", "modulation", "amplitude", "depth", "offset"),
    "decaying": ("frequency", "amplitude", "offset", "decay"),
    "reversal_curves": ("low", "high", "count", "rate"),
}
SETTINGS = {"samples": 500, "periods": 8, "settle": 4, "demagnetize": True, "tries": 3}
POSITIVE = ("frequency", "amplitude", "carrier", "modulation", "count", "rate")
FEWEST = 40  # samples a period that a loop needs


@dataclasses.dataclass(frozen=True)
class Entry:
    """One recording to make: `drive` as in `Order`, `rate` Hz, samples to keep and to wait for, what it is."""

    name: str
    drive: dict
    rate: float
    samples: int
    settle_samples: int
    frequency: float | None
    text: str

    @property
    def peak(self) -> float:
        """Largest absolute current, A."""
        return Order("", "", drive=self.drive).peak()

    def same(self) -> str:
        """What tells this drive from another of the same name, for the log's start event."""
        content = json.dumps([self.drive, self.rate, self.samples], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True)
class Plan:
    """A study: settings and the list of drives as the file gives them."""

    settings: dict
    drives: tuple
    source: str = "plan"


def read_plan(path) -> Plan:
    """A study file; raises `ConfigurationError` naming the key and the mend."""
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigurationError(f"plan {path}: {error.strerror or error}; give a TOML file with [[drives]]") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"plan {path}: not valid TOML ({error})") from None
    drives = content.pop("drives", [])
    for key, value in content.items():
        if key not in SETTINGS:
            raise ConfigurationError(f"plan {path}: {key} is unknown; known are {', '.join(SETTINGS)} and [[drives]]")
        if type(value) is not type(SETTINGS[key]) or (not isinstance(value, bool) and value < (0 if key == "settle" else 1)):
            raise ConfigurationError(f"plan {path}: {key} = {value!r}; write it like {SETTINGS[key]!r}".replace("True", "true"))
    if not isinstance(drives, list) or not drives or not all(isinstance(row, dict) for row in drives):
        raise ConfigurationError(f"plan {path}: holds no [[drives]] (in double brackets); name at least one")
    for row in drives:
        _check_row(path, row)
    return Plan({**SETTINGS, **content}, tuple(drives), str(path))


def _check_row(path, row):
    kind = row.get("kind", "sine")
    if kind not in KEYS:
        raise ConfigurationError(f'plan {path}: kind = "{kind}" is unknown; known are {", ".join(KEYS)}')
    for key in row:
        if key != "kind" and key not in KEYS[kind]:
            raise ConfigurationError(f"plan {path}: {key} is unknown for a {kind}; it takes {', '.join(KEYS[kind])}")
    for key in KEYS[kind]:
        if key not in row:
            if key not in ("offset", "depth", "decay"):
                raise ConfigurationError(f"plan {path}: a {kind} needs {key}")
            continue
        many = kind == "sine" or (kind, key) == ("multisine", "frequency")
        values = row[key] if many and isinstance(row[key], list) else [row[key]]
        good = [isinstance(v, (int, float)) and not isinstance(v, bool) and np.isfinite(v) for v in values]
        if not good or not all(good) or (key in POSITIVE and min(values) <= 0):
            what = "a number above zero" if key in POSITIVE else "a number"
            raise ConfigurationError(
                f"plan {path}: {key} = {row[key]!r} of a {kind}; give {what}{', or a list of such' if many else ''}"
            )


def entries(plan: Plan, rate_max: float = 2e5) -> list[Entry]:
    """The recordings of a plan, for a device that samples at most at `rate_max` Hz."""
    found = []
    for row in plan.drives:
        found += _entries({**row}, plan.settings, rate_max)
    return [dataclasses.replace(e, name=f"{k:03d}_{e.name}") for k, e in enumerate(found)]


def _list(value):
    return [float(v) for v in (value if isinstance(value, list) else [value])]


def _entries(row, settings, rate_max):
    kind = row.pop("kind", "sine")
    if kind == "sine":
        grid = [(f, a, o) for f in _list(row["frequency"]) for a in _list(row["amplitude"]) for o in _list(row.get("offset", 0.0))]
        return [sine_entry(*point, settings, rate_max) for point in grid]
    if kind == "multisine":
        base = waveforms.multisine(
            _list(row["frequency"]), row["amplitude"], row.get("offset", 0.0), periods=1, samples=20000
        ).frequency
        width = _width(base, settings["samples"] * round(max(_list(row["frequency"])) / base), rate_max)
        drive = waveforms.multisine(_list(row["frequency"]), row["amplitude"], row.get("offset", 0.0), periods=1, samples=width)
        return [_table_entry("multisine", drive, settings)]
    if kind == "minor_loops":
        width = _width(row["modulation"], settings["samples"] * round(row["carrier"] / row["modulation"]), rate_max)
        depth, offset = row.get("depth", 0.6), row.get("offset", 0.0)
        drive = waveforms.modulated_sine(
            row["carrier"], row["modulation"], row["amplitude"], depth, offset, periods=1, samples=width
        )
        return [_table_entry("minor_loops", drive, settings)]
    if kind == "decaying":
        width = _width(row["frequency"], settings["samples"], rate_max)
        drive = waveforms.decaying(
            row["frequency"], row["amplitude"], row.get("offset", 0.0), decay=row.get("decay", 0.9), samples=width
        )
    else:
        drive = waveforms.reversal_curves(row["low"], row["high"], row["count"], row["rate"])
    return [_table_entry(kind, drive, settings)]


def _width(frequency, wanted, rate_max):
    width = int(min(wanted, rate_max / frequency, 60000))
    if width < FEWEST:
        raise ConfigurationError(
            f"{frequency:g} Hz leaves {width} samples a period at {rate_max:g} samples/s; {FEWEST} are needed: lower the frequency"
        )
    return width


def sine_entry(frequency, amplitude, offset, settings, rate_max) -> Entry:
    """A sine made on the device."""
    if not (frequency > 0 and amplitude > 0):
        raise ConfigurationError(f"a sine of {amplitude:g} A at {frequency:g} Hz: give both above zero")
    width = _width(frequency, settings["samples"], rate_max)
    rate = min(round(1000 * frequency * width) / 1000, rate_max)
    drive = {"kind": "sine", "samples": width, "periods": 0, "amplitude": amplitude, "offset": offset, "factor": 1.0}
    text = f"sine {frequency:g} Hz, {amplitude:g} A about {offset:g} A"
    name = f"sine_{frequency:g}Hz_{amplitude:g}A"
    return Entry(name, drive, rate, settings["periods"] * width, settings["settle"] * width, rate / width, text)


def _table_entry(kind, drive, settings):
    periodic = drive.frequency is not None
    count = len(drive.values)
    table = {"kind": "table", "values": drive.values.tolist(), "repeats": 0 if periodic else 1}
    rate = round(1000 / drive.dt) / 1000
    samples, settle = (settings["periods"] * count, settings["settle"] * count) if periodic else (count, 0)
    return Entry(kind, table, rate, samples, settle, rate / count if periodic else None, drive.name)


@dataclasses.dataclass
class Campaign:
    """Where and how a list of entries is recorded. `say(text)`: progress; `live(dict)`: the recorder's reports; `header`: provenance;
    `amplifier`: port of a SCPI amplifier."""

    port: str
    bench: object
    folder: Path
    limit: float | None
    settings: dict
    header: dict
    baud: int = 2_000_000
    durable: bool = False
    give_up_s: float = 15.0
    say: object = print
    live: object = None
    amplifier: str | None = None
    hello: object = None

    def rate_max(self) -> float:
        """What the device samples at most, Hz."""
        port = open_port(self.port, self.baud)
        try:
            self.hello = ask_hello(port, 5.0)
        finally:
            port.close()
        return self.hello.rate_max

    def check_limits(self, found) -> None:
        """Refuse the whole plan before anything moves: what the bench does not bear, and what the device cannot do."""
        for entry in found:
            order = Order(
                self.port, "", entry.rate, entry.samples, entry.settle_samples, entry.drive, self.baud, give_up_s=self.give_up_s
            )
            order.check_numbers()
            if self.hello:
                order.check(self.hello)
            if self.limit and entry.peak > self.limit * (1 + 1e-9):
                raise ConfigurationError(
                    f"the plan's drive {entry.text} reaches {entry.peak:.4g} A where the limit is {self.limit:g} A; lower it, or raise limits.current_A"
                )

    def run(self, found) -> list[dict]:
        """Record every entry that is not there yet; a row each: name, file, status, problems, tries. Stops at status 5 and 130."""
        self.check_limits(found)
        rows, place = [], self.folder / "campaign.json"
        for k, entry in enumerate(found):
            self.say(f"{k + 1} of {len(found)}: {entry.text}")
            row = self.one(entry)
            rows.append(row)
            partial = place.with_name(place.name + ".part")
            partial.write_text(json.dumps({"recordings": rows}, indent=1))
            partial.replace(place)
            if row["status"] in (5, 130):
                break
        return rows

    def one(self, entry: Entry) -> dict:
        """One entry: recorded until it passes its check, `tries` times at most; a recording that is there and good is kept.

        What is in the way is put aside as NAME.mjlog.bad0 or, where it holds another drive, as NAME.mjlog.other0.
        """
        path = self.folder / f"{entry.name}.mjlog"
        if path.exists() and not self._another(path, entry) and not self.problems(path, entry):
            return {"name": entry.name, "file": str(path), "status": 0, "problems": [], "tries": 0, "text": entry.text}
        problems, settle = [], entry.settle_samples
        for attempt in range(1, self.settings["tries"] + 1):
            if path.exists():
                why = "other" if self._another(path, entry) else "bad"
                count = len(list(self.folder.glob(f"{glob.escape(path.name)}.{why}*")))
                path.rename(self.folder / f"{path.name}.{why}{count}")  # no *.mjlog finds it
            order = Order(
                self.port, str(path), entry.rate, entry.samples, settle, entry.drive, self.baud, self.limit, durable=self.durable,
                give_up_s=self.give_up_s, amplifier=self.amplifier, demagnetize=bool(self.settings["demagnetize"]), header=self.header,
                about={"settle_samples": settle, "drive": entry.text, "entry": entry.same()} | ({"frequency_Hz": entry.frequency} if entry.frequency else {}),
                loop_samples=min(entry.samples, 4000),
            )  # fmt: skip
            end = record(order, self.live)
            if end["status"] in (5, 130) or end["state"] == "refused":
                return {
                    "name": entry.name,
                    "file": str(path),
                    "status": end["status"],
                    "problems": [end["reason"]],
                    "tries": attempt,
                    "text": entry.text,
                }
            problems = self.problems(path, entry) if end["status"] == 0 else [end["reason"]]
            if not problems:
                export_log(path, path.with_suffix(".nc"))
                break
            self.say(f"  try {attempt} is not fit to use: {problems[0]}")
            settle = 2 * settle if any("transient" in text or "drift" in text for text in problems) else settle
        return {
            "name": entry.name,
            "file": str(path),
            "status": 3 if problems else 0,
            "problems": problems,
            "tries": attempt,
            "text": entry.text,
        }

    @staticmethod
    def _another(path, entry) -> bool:
        """Does a log of this name hold another drive? (The plan was changed since.)"""
        try:
            starts = [e for e in Log(path).events if e["event"] == "start"]
        except MagjaxError:
            return False
        return any(e.get("entry", entry.same()) != entry.same() for e in starts)

    def problems(self, path, entry: Entry) -> list[str]:
        """Why a recording is not fit to use; empty where it is."""
        from ..inspection import inspect
        from ..readers import load_recordings

        try:
            recordings = load_recordings([path], self.bench)
            recording = recordings[-1]
            if len(recordings) > 1:
                return [f"the device was reset: {len(recordings)} segments"]
            # a drive that runs once has no repeats to judge
            found = list(inspect(recording, self.bench).problems) if entry.frequency else []
        except MagjaxError as error:
            return [str(error)]
        if recording.n_samples < 0.9 * entry.samples:
            found.append(f"{recording.n_samples} of {entry.samples} samples came")
        current = recording.channels.get("current")
        wanted = np.ptp(np.asarray(entry.drive["values"])) if entry.drive["kind"] == "table" else 2 * entry.drive["amplitude"]
        if current is not None and not 0.5 * wanted < np.ptp(current) < 1.5 * wanted:
            found.append(
                f"the current spans {np.ptp(current):.3g} A where {wanted:.3g} A were commanded; check amplifier and shunt"
            )
        return found
