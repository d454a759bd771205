"""Commands check, import, export."""

import json
import sys
from pathlib import Path

from .runtime import output_folder, parser, refuse_overwriting

ASSUMED = "aa-050h"  # the bench where none is given


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    return {"check": run_check, "import": run_convert, "export": run_convert}[command](arguments, command)


def run_check(arguments, _command) -> int:
    """magjax check."""
    p = parser(
        "check",
        "Is a recording fit to use? Units, clipping, gaps, counts, drift, transient, lag, visited range.",
        "magjax check rec.csv --bench aa-050h",
    )
    p.add_argument("recordings", nargs="+", help="recordings")
    p.add_argument("--bench", help=f"bench file (TOML) or a built-in name (default {ASSUMED})")
    options = p.parse_args(arguments)
    from magjax.bench import load_bench
    from magjax.inspection import inspect_files

    if options.bench is None:
        print(f"bench: {ASSUMED} (limits and coil of T&B's actuator); give yours with --bench", file=sys.stderr)
    cards = inspect_files(options.recordings, load_bench(options.bench or ASSUMED))
    if options.json:
        print(json.dumps([c.as_dict() for c in cards]))
    else:
        print("\n\n".join(str(c) for c in cards))
    return 3 if any(c.problems for c in cards) else 0


def run_convert(arguments, command) -> int:
    """magjax import and export: recordings from one format into another."""
    p = parser(
        command,
        "Convert recordings: the ending of --out says into what (.nc, .csv, .mat, .parquet).",
        f"magjax {command} rec.mat --out rec.nc",
    )
    p.add_argument("recording", help="a recording")
    p.add_argument("--bench", default=ASSUMED, help="bench file (TOML) or a built-in name")
    p.add_argument("--out", required=True, help="file to write: .nc, .csv, .mat or .parquet")
    options = p.parse_args(arguments)
    from magjax.bench import load_bench
    from magjax.recording import load_recordings
    from magjax.writers import write_recording

    target = Path(options.out)
    output_folder(target.parent)
    refuse_overwriting(target, options.recording)
    written = []
    if Path(options.recording).suffix.lower() == ".mjlog" and Path(options.recording).is_file():  # with command and provenance
        from magjax.acquire.export import export_log

        written = [str(path) for path in export_log(options.recording, target)]
        print(json.dumps({"files": written}) if options.json else "wrote " + ", ".join(written))
        return 0
    recordings = load_recordings([options.recording], load_bench(options.bench))
    for k, recording in enumerate(recordings):
        path = target if len(recordings) == 1 else target.with_name(f"{target.stem}_{k:03d}{target.suffix}")
        write_recording(path, recording)
        written.append(str(path))
    print(json.dumps({"files": written}) if options.json else "wrote " + ", ".join(written))
    return 0
