"""Command invert."""

import json

from .runtime import parser


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    return run_invert(arguments)


def run_invert(arguments) -> int:
    """magjax invert."""
    p = parser("invert", "The current that makes the actuator follow a wanted displacement, by T&B (7).",
               "magjax invert wanted.csv --model result --out current.csv")  # fmt: skip
    p.add_argument("trajectory", help="CSV with time_s and displacement_m (or _um)")
    p.add_argument("--bench", help="bench file (TOML) or a built-in name")
    p.add_argument("--model", help="a fitted result folder")
    p.add_argument("--out", default="current.csv", help="CSV to write: time_s, current_A")
    options = p.parse_args(arguments)
    from magjax.inverse.command import invert_file

    summary = invert_file(options.trajectory, options.bench, options.model, options.out)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0
