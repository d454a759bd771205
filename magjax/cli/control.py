"""Commands invert and control."""

import json
import sys

from .runtime import Progress, output_folder, parser, refuse_overwriting

USAGE = """usage: magjax control {design,bounds,simulate,compare} [OPTIONS]

  design    l1-optimal robust controller (T&B Sec. 4): certified gamma, hard rows, margins
  bounds    the inversion's error by T&B Props. 4.1-4.3 beside a simulated worst case
  simulate  one strategy on one trajectory: CSV with time_s, wanted_m, reached_m, current_A
  compare   every strategy on the nominal plant, on one with fit errors, and on a bench with
            concealed physics before and after its repair

example: magjax control design --u-bar 3.25 --out design"""


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    if command == "invert":
        return run_invert(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if arguments[0] not in ACTIONS:
        print(f'magjax control: no action "{arguments[0]}"; give one of {", ".join(ACTIONS)}', file=sys.stderr)
        return 2
    return ACTIONS[arguments[0]](arguments[1:])


def run_invert(arguments) -> int:
    """magjax invert."""
    p = parser("invert", "The current (of a piezo stack the voltage) that makes the actuator follow a wanted displacement, by T&B (7).",
               "magjax invert wanted.csv --model result --out current.csv")  # fmt: skip
    p.add_argument("trajectory", help="CSV with time_s and displacement_m (or _um)")
    p.add_argument("--bench", help="bench file (TOML) or a built-in name")
    p.add_argument("--model", help="a fitted result folder")
    p.add_argument("--out", default="current.csv", help="CSV to write: time_s, current_A (voltage_V)")
    p.add_argument(
        "--of-reading", action="store_true", help="the trajectory is that of the sensor's reading: undo its lag and delay too"
    )
    options = p.parse_args(arguments)
    from magjax.inverse.command import invert_file

    refuse_overwriting(options.out, options.trajectory)
    summary = invert_file(options.trajectory, options.bench, options.model, options.out, options.of_reading)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0


def _plant(options):
    return _plant_and_bench(options)[0]


def _plant_and_bench(options):
    from magjax.inverse.command import load_actuator
    from magjax.inverse.dynamic import PlainActuator

    actuator, bench = load_actuator(options.bench, options.model)
    return PlainActuator.from_actuator(actuator), bench


def _common(name, text, example):
    p = parser(f"control {name}", text, example)
    p.add_argument("--bench", default=None, help="bench file (TOML) or a built-in name (default aa-050h)")
    p.add_argument("--model", help="a fitted result folder")
    p.add_argument("--T", type=float, default=5e-4, help="sample time, s (default 5e-4)")
    p.add_argument("--u-bar", type=float, default=3.25, help="saturation in units of M_s^2 (default 3.25, T&B Fig. 16)")
    return p


def run_design(arguments) -> int:
    """magjax control design."""
    p = _common(
        "design",
        "The l1-optimal controller of T&B Sec. 4.2 for the rod of a bench or a fitted model.",
        "magjax control design --u-bar 3.25 --out design",
    )
    p.add_argument("--r-bar", type=float, default=30.0, help="largest reference, um (default 30)")
    p.add_argument("--w-bar", type=float, default=0.1, help="largest inversion error, M_s^2 (default 0.1)")
    p.add_argument("--c-w", type=float, default=6.53e-13, help="size of the model's uncertainty, um per (A/m)^2 (default 6.53e-13)")
    p.add_argument("--taps", type=int, default=40, help="taps of the Youla parameter (default 40)")
    p.add_argument("--figures", action="store_true", help="also compute T&B Figs. 13-15 (needs --out)")
    p.add_argument("--out", help="folder for design.json and the figures")
    options = p.parse_args(arguments)
    folder = output_folder(options.out)
    from magjax.control.command import design_summary

    summary = design_summary(_plant(options), options, folder)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0


def run_bounds(arguments) -> int:
    """magjax control bounds."""
    p = _common(
        "bounds",
        "Bounds of the inversion's error, T&B Props. 4.1-4.3, and a simulated worst case.",
        "magjax control bounds --delta-I 0.05 --T 5e-4",
    )
    p.add_argument("--delta-I", type=float, default=0.05, help="relative error of the Preisach masses (default 0.05)")
    options = p.parse_args(arguments)
    from magjax.control.command import bounds_summary

    summary = bounds_summary(_plant(options), options)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0


def run_simulate(arguments) -> int:
    """magjax control simulate."""
    p = _common(
        "simulate",
        "One tracking strategy on the actuator, integrated event by event.",
        "magjax control simulate --strategy l1 --out track.csv",
    )
    p.add_argument(
        "--strategy", default="dynamic_inverse", help="proportional, static_inverse, dynamic_inverse, l1, l1_over_relaxed"
    )
    p.add_argument(
        "--trajectory", default="sine", help="sine (20 Hz), aperiodic (round 30 Hz), or a CSV with time_s and displacement_m"
    )
    p.add_argument("--out", default="track.csv", help="CSV to write")
    options = p.parse_args(arguments)
    from magjax.control.command import simulate_summary

    plant, bench = _plant_and_bench(options)
    summary = simulate_summary(plant, options, bench.columns)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0


def run_compare(arguments) -> int:
    """magjax control compare."""
    p = _common("compare", "Every strategy: nominal plant, fit errors, noise, and a concealed bench before and after its repair.",
                "magjax control compare --hide amplifier_lag --out study")  # fmt: skip
    p.add_argument(
        "--hide",
        default="amplifier_lag",
        choices=("amplifier_lag", "quartic_magnetostriction", "none"),
        help="what to conceal (default amplifier_lag)",
    )
    p.add_argument("--out", help="folder for study.json and the figure")
    options = p.parse_args(arguments)
    folder = output_folder(options.out)
    from magjax.control.command import HIDDEN, compare_summary

    with Progress(options.quiet) as progress:

        def benches():  # the data side of the study: only the command line stands above both
            from fitting.demo import tracking_benches

            return tracking_benches(options.bench or "aa-050h", options.hide, HIDDEN[options.hide], options.seed, progress)

        summary = compare_summary(_plant(options), options, folder, None if options.hide == "none" else benches)
    print(json.dumps(summary) if options.json else summary["message"])
    return 0


ACTIONS = {"design": run_design, "bounds": run_bounds, "simulate": run_simulate, "compare": run_compare}
