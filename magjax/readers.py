"""Tables into recordings: split, checked, gaps bridged, captures joined, an emf into flux density, a loop into a period."""

import hashlib
from pathlib import Path

import numpy as np

from .bench import load_bench
from .clipping import is_passed, refuse_clipping
from .columns import USUAL, column_of, quantity_of
from .errors import ConfigurationError, RecordingError
from .formats import read_table
from .pickup import bridge_gaps, integrate_emf, merge_captures, without_empty, without_strays
from .plausibility import check_sizes
from .recording import BYSTANDERS, Recording, refuse_constant

WRITTEN = 1e-5  # of a channel's range: more digits than that are written


def load_recordings(paths, bench, holds=()) -> list[Recording]:
    """Recordings of one or several files, SI, as the bench names their columns; `holds`: (channel, side) where a flat crest is no clipping,
    side 1.0 for the highest, -1.0 for the lowest values.

    Raises `RecordingError` naming file, column and mend.
    """
    bench = load_bench(bench)
    if bench.output == "strain":
        raise ConfigurationError('fit.output = "strain" reads a table of strain curves, no recording: give it to magjax diagnose')
    paths = [paths] if isinstance(paths, (str, Path)) else list(paths)
    if not paths:
        raise ConfigurationError("no recording given; name one or several files")
    recordings = []
    for path in paths:
        recordings += read_file(Path(path), bench, holds)
    return recordings


def load_sound(paths, bench) -> tuple[list[Recording], list[RecordingError]]:
    """The recordings that can be used, and the error of each file that cannot. A crest that is flat at a level which other files pass was
    not cut by the instrument: those are used."""
    found = [_tried(path, bench) for path in paths]
    for k, path in enumerate(paths):
        holds = ()
        while _is_no_limit(found[k], found):
            holds = (*holds, (found[k].shown["channel"], found[k].shown["rests"][0]))
            found[k] = _tried(path, bench, holds)
    errors = [one for one in found if isinstance(one, RecordingError)]
    return [r for one in found if not isinstance(one, RecordingError) for r in one], errors


def _tried(path, bench, holds=()):
    """A file's recordings, or its error."""
    try:
        return load_recordings([path], bench, holds)
    except RecordingError as error:
        return error


def _is_no_limit(error, found) -> bool:
    """Whether what a file was refused for is a crest that is flat at a level which others pass; `found`: recordings or the error of each."""
    if not isinstance(error, RecordingError) or "rests" not in (error.shown or {}):
        return False
    channel, others = error.shown["channel"], []
    for one in found:
        if not isinstance(one, RecordingError):
            others += [r.channels[channel] for r in one if channel in r.channels]
        elif one is not error and (one.shown or {}).get("channel") == channel:
            others.append(one.shown["values"])
    return is_passed(error.shown, others)


def load_checks(paths, bench) -> tuple[list[Recording], tuple[str, ...]]:
    """Recordings to check against, and a sentence for each that cannot be used: no fit needs them, so they end none.

    Raises `RecordingError` where a file does not exist.
    """
    recordings, refused = [], []
    for path in map(Path, paths):
        try:
            recordings += load_recordings([path], bench)
        except RecordingError as error:
            if not path.exists():
                raise
            refused.append(str(error))
    return recordings, tuple(refused)


def load_calibrations(paths, bench) -> list[Recording]:
    """Calibrations of the sensor: time, `reference` (the known displacement, m, by a reference sensor) and the reading.

    Any periodic motion of the sensor, without a coil current. Raises `RecordingError` naming file, column and mend.
    """
    bench = load_bench(bench)
    found = []
    for path in map(Path, paths):
        origin = {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} if path.is_file() else {}
        for table, metadata in read_table(path):
            wanted = ("time", "reference", bench.output)
            columns = {q: quantity_of(path, table, q, bench.columns.get(q, {}), required=True) for q in wanted}
            refuse_constant(path.name, bench.output, columns[bench.output])
            time, channels, _ = bridge_gaps(columns["time"] - columns["time"][0], {q: columns[q] for q in wanted[1:]}, "reference")
            found.append(
                Recording(time, channels, {}, {**origin, "metadata": {k: _number(v) for k, v in metadata.items()}}, path.name)
            )
    return found


def refuse_absent_and_twice(recordings, checks=(), more=()) -> None:
    """Raise `RecordingError` where a file is not there, and `ConfigurationError` where one is given twice, as a recording or to
    check: it would count twice, or check nothing."""
    seen = {}
    for path, what in (
        *((p, "recording") for p in recordings),
        *((p, "check") for p in checks),
        *((p, "calibration") for p in more),
    ):
        path = Path(path)
        if not path.exists():
            raise RecordingError(f"{path}: no such file; check the name")
        if not path.is_file() or what == "calibration":
            continue
        content = hashlib.sha256(path.read_bytes()).digest()
        if content in seen:
            other, before = seen[content]
            same = "is given twice" if other.resolve() == path.resolve() else f"holds the same as {other}"
            counts = "a check that is also fitted checks nothing" if before != what else "it would count twice"
            raise ConfigurationError(f"{path}: {same}; {counts}: leave one out")
        seen[content] = path, what


def refuse_copies(recordings, checks, bench) -> None:
    """Raise `ConfigurationError` where two recordings hold the same samples of drive and reading, saved in files that differ."""
    rows = [(r, what) for what, group in (("recording", recordings), ("check", checks)) for r in group]
    for k, (recording, what) in enumerate(rows):
        for other, before in rows[:k]:
            if all(_same_samples(recording.channels[q], other.channels[q]) for q in (bench.drive, bench.output)):
                counts = "a check that is also fitted checks nothing" if before != what else "it would count twice"
                raise ConfigurationError(f"{recording.name}: holds the samples of {other.name}; {counts}: leave one out")


def _same_samples(one, other) -> bool:
    """Whether two channels are equal but for the digits that they were written with."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    return one.shape == other.shape and bool(np.max(np.abs(one - other)) <= WRITTEN * np.ptp(one))


def read_columns(path: Path, bench, quantities) -> dict:
    """Columns of one table as they stand, without a time axis: quantity -> values in SI, for those that it holds."""
    table, _ = read_table(Path(path))[0]
    found = {q: quantity_of(path, table, q, bench.columns.get(q, {}), required=q == bench.output) for q in quantities}
    return {q: v for q, v in found.items() if v is not None}


def read_file(path: Path, bench, holds=()) -> list[Recording]:
    """All recordings in one file; `holds` as of `load_recordings`."""
    tables = read_table(path)
    origin = {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return [r for table, metadata in tables for r in _recordings(path, table, {**origin, "metadata": metadata}, bench, holds)]


def _recordings(path, table, origin, bench, holds) -> list[Recording]:
    split = bench.columns.get("time", {}).get("split")
    columns, units, available = {}, {}, list(table)
    _refuse_missing(path, table, bench)
    for quantity in (
        "time",
        "voltage",
        "temperature",
        "magnetization",
        "polarization",
        "flux_density",
        "displacement",
        "current",
        "command",
        "field",
    ):
        column = bench.columns.get(quantity, {})
        found = quantity_of(path, table, quantity, column, required=quantity in (bench.drive, bench.output))
        if found is not None:
            columns[quantity], units[quantity] = found, column_of(path, table, quantity, column)[1]
    if len({len(v) for v in columns.values()}) > 1:
        lengths = ", ".join(f"{q} {len(v)}" for q, v in columns.items())
        raise RecordingError(f"{path}: columns of unequal length ({lengths}); save as many samples of each")
    if not bench.quasistatic and "time" not in columns:
        raise RecordingError(f"{path}: no time column among {', '.join(available)}; name one time_s or map it in [columns.time]")
    if split is not None:
        if split not in table:
            raise RecordingError(f"{path}: no column {split} to split at; the file has {', '.join(available)}")
        bad = ~np.isfinite(np.asarray(table[split], float))
        if bad.any():
            raise RecordingError(
                f"{path}: {split}, at which the file is split, is no number in row {int(np.argmax(bad))}; fill it in"
            )
        labels = list(dict.fromkeys(table[split]))
        parts = [(f"{path.name}[{split}={label:g}]", table[split] == label) for label in labels]
    else:
        parts = [(path.name, np.ones(len(columns[bench.drive]), bool))]
    if not bench.quasistatic:
        for name, rows in parts:
            _refuse_clipping(name, {q: v[rows] for q, v in columns.items()}, bench, holds)
    if bench.columns.get("time", {}).get("merge"):
        columns, filled = merge_captures([{q: v[rows] for q, v in columns.items()} for _, rows in parts], bench, path)
        if filled:
            origin = {**origin, "metadata": {**origin["metadata"], "bridged_samples": filled}}
        return [_one(path.name, columns, units, origin, bench, holds)]
    return [_one(name, {q: v[rows] for q, v in columns.items()}, units, origin, bench, holds) for name, rows in parts]


def _refuse_missing(path, table, bench):
    """Where several columns are missing, one line names them all (of a single one, `quantity_of` tells how to name it)."""
    wanted = (*(() if bench.quasistatic else ("time",)), bench.drive, bench.output)
    missing = [q for q in dict.fromkeys(wanted) if column_of(path, table, q, bench.columns.get(q, {}))[0] is None]
    if len(missing) > 1:
        usual = ", ".join(bench.columns.get(q, {}).get("name", USUAL[q]) for q in missing)
        raise RecordingError(
            f"{path}: no columns for {', '.join(missing)} among {', '.join(table)}; name them {usual} or map them in [columns] of the bench"
        )


def _refuse_clipping(name, columns, bench, holds):
    """Clipping is seen in what the converter read: before gaps are filled, captures joined or an emf is integrated."""
    for quantity, values in columns.items():
        if quantity not in ("time", *BYSTANDERS):
            what = f"the emf of {quantity}" if "emf_turns" in bench.columns.get(quantity, {}) else quantity
            sides = [side for channel, side in holds if channel == what]
            try:
                refuse_clipping(name, what, values, None if quantity == bench.drive else columns[bench.drive], sides)
            except RecordingError as error:
                error.shown = {**error.shown, "name": name, "time": columns.get("time")}
                raise


def _one(name, columns, units, origin, bench, holds) -> Recording:
    quasistatic = bench.quasistatic
    count = len(columns[bench.drive])
    if count < 2:
        raise RecordingError(f"{name}: holds one sample only; record again, or check the columns and the split of the file")
    metadata = dict(origin["metadata"])
    if quasistatic:
        columns = _uniform_loop({**columns}, bench, name)
        count = len(columns[bench.drive])
        time = np.arange(count) / count
        metadata["frequency_Hz"] = 1.0
        origin = {**origin, "quasistatic": True}
    else:
        if not np.isfinite(columns["time"]).all():
            sample = int(np.argmax(~np.isfinite(columns["time"])))
            raise RecordingError(f"{name}: the time of sample {sample} is no number; remove that row, or write its time")
        time = columns["time"] - columns["time"][0]
    channels = {q: v for q, v in columns.items() if q != "time"}
    if not quasistatic:
        if not np.median(np.diff(time)) > 0:
            raise RecordingError(f"{name}: time does not increase from most samples to the next; rewrite the time column")
        time, channels = without_empty(time, channels)
        widest = int(round(np.diff(time).max() / max(float(np.median(np.diff(time))), 1e-300))) - 1
        channels, strays = without_strays(time, channels, bench.drive)
        if strays:
            metadata |= {"stray_samples": sum(strays.values()), "stray_channels": " and ".join(strays)}
        time, channels, bridged = bridge_gaps(time, channels, bench.drive)
        if bridged:
            metadata |= {"bridged_samples": bridged, "widest_gap_samples": widest}
    check_sizes(name, channels, units, bench)
    refuse_constant(name, bench.output, channels[bench.output])
    column = bench.columns.get(bench.output, {})
    if "emf_turns" in column:
        dt = float(np.median(np.diff(time)))
        channels[bench.output] = integrate_emf(channels[bench.output], channels[bench.drive], dt, column)
    metadata = {k: _number(v) for k, v in metadata.items()}
    return Recording(time, channels, {}, {**origin, "metadata": metadata}, name, judged=bool(holds))


def _number(value):
    try:
        return float(value)
    except (TypeError, ValueError):
        return value


def _uniform_loop(columns, bench, name):
    """A quasi-static loop given as points: closed, and resampled evenly along its length in (drive, output)."""
    x, y = columns[bench.drive], columns[bench.output]
    bad = ~(np.isfinite(x) & np.isfinite(y))
    if bad.any():
        raise RecordingError(f"{name}: not a number at point {int(np.argmax(bad))} of the loop; remove that point")
    refuse_constant(name, bench.drive, x)
    ahead = np.concatenate([[0], np.cumsum(np.abs(np.diff(x)))])
    # points that stand still in the drive carry no new information for a rate-independent loop
    keep = np.concatenate([[True], np.diff(ahead) > 0])
    ahead, x, y = ahead[keep], x[keep], y[keep]
    closing = abs(x[0] - x[-1])
    total = ahead[-1] + closing if closing > 1e-6 * np.ptp(x) else ahead[-1]
    if closing > 1e-6 * np.ptp(x):
        ahead, x, y = np.append(ahead, total), np.append(x, x[0]), np.append(y, y[0])
    # even steps of phase of a sine between the extremes put points where the loop bends
    n = 512
    top, bottom = x.max(), x.min()
    phase = 2 * np.pi * np.arange(n) / n
    drive = 0.5 * (top + bottom) + 0.5 * (top - bottom) * np.cos(phase)
    travelled = np.concatenate([[0], np.cumsum(np.abs(np.diff(drive)))])
    start = ahead[np.argmax(x)]
    place = (start + travelled * (total / (2 * (top - bottom)))) % total
    return {bench.drive: np.interp(place, ahead, x), bench.output: np.interp(place, ahead, y)}
