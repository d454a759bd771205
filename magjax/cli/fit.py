"""Commands fit, diagnose, demo, report."""

import json
import sys
from pathlib import Path

from magjax.errors import ConfigurationError, MagjaxError
from magjax.words import sized

from .runtime import Progress, as_json, minutes, output_folder, parser, positive, prepare_jax, told
from .scale import (
    add_intervals,
    add_where,
    check_intervals,
    check_placebo,
    intervals,
    placebo_text,
    refuse_profile,
    run_fleet,
    with_placebo,
)

MINUTES = 15.0  # of a search for effects
MOST_CELLS = 120  # a mass a cell: 7260 of them, and a normal matrix of 420 MB


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    return {"fit": run_fit, "diagnose": run_diagnose, "demo": run_demo, "report": run_report}[command](arguments)


def _reproduce(command, arguments):
    import shlex

    return "magjax " + command + " " + " ".join(shlex.quote(a) for a in arguments)


def _written(folder, *names) -> str:
    """Where the results are, and which: no model.json stands for a fit that broke down."""
    return f"{folder} ({', '.join(name for name in names if (folder / name).exists())})"


def _bench_and_start(options):
    from magjax.bench import load_bench

    if options.model is not None:
        from magjax.model_file import load_model

        actuator, bench = load_model(options.model)
        return (told(load_bench(options.bench)) if options.bench else bench), _on_bench(actuator, options.bench)
    if not options.bench:
        raise ConfigurationError("give --bench (a TOML file or aa-050h), or --model with a fitted folder")
    return told(load_bench(options.bench)), None


def _on_bench(actuator, named):
    """A model's actuator with the fixed constants of the bench that is named beside it: those of its coil and its rod; differences are told."""
    from magjax.bench import load_bench

    bench = load_bench(named) if named else None
    known = actuator.parameters()
    fixed = {
        n: v
        for n, v in (bench.constants if bench else {}).items()
        if n in known and n.split(".")[0] in ("coil", "magnetostriction")
    }
    other = {n: v for n, v in fixed.items() if n not in bench.free and abs(float(known[n][0]) - v) > 1e-9 * abs(v)}
    if other:
        said = ", ".join(f"{n} = {v:g} ({float(known[n][0]):g} in the model)" for n, v in other.items())
        print(f"--bench and --model differ; the bench holds: {said}", file=sys.stderr)
    return actuator.replace(other) if other else actuator


def _common(command, text, example, recordings="+"):
    p = parser(command, text, example)
    p.add_argument("recordings", nargs=recordings, help="recordings (CSV, NetCDF, .mat)")
    p.add_argument("--bench", help="bench file (TOML) or a built-in name")
    p.add_argument(
        "--model", help="constants and effects to start from: a fitted result folder (its masses too, where the bench holds them)"
    )
    p.add_argument("--check", nargs="+", action="extend", default=[], help="recordings to predict that take no part in the fit")
    p.add_argument("--out", help="folder for the results and the report")
    p.add_argument("--max-jacobians", type=positive, default=30, help="limit of the iteration (default 30)")
    return p


def run_fit(arguments) -> int:
    """magjax fit."""
    p = _common("fit", "Joint fit: all Preisach masses with R_eddy, xi and f0 (or what the bench frees) to all recordings.",
                "magjax fit rec_*.csv --bench aa-050h --out result", "*")  # fmt: skip
    p.add_argument("--cells", type=int, help="fit one unknown a cell at this level instead of a smooth density")
    p.add_argument(
        "--recipe", action="store_true", help="beside the fit T&B's own recipe for R_eddy and xi (Sec. 2.3): phase lags over a mesh"
    )
    add_intervals(p)
    options = p.parse_args(arguments)
    check_intervals(options)
    prepare_jax()
    from magjax.readers import load_checks, load_recordings, refuse_absent_and_twice, refuse_copies

    folder = output_folder(options.out)
    refuse_absent_and_twice(options.recordings, options.check)
    from fitting.check import check_errors
    from fitting.fit import fit
    from fitting.foretold import Foreteller
    from fitting.reach import beyond_text
    from fitting.setup import Choices, effect_parameters, free_parameters

    choices = Choices(max_jacobians=options.max_jacobians)
    if options.cells is not None and not 2 <= options.cells <= MOST_CELLS:
        p.error(f"--cells {options.cells}: the plane needs at least 2 cells along each threshold and takes {MOST_CELLS}, say 25")
    if options.cells:
        choices = Choices(level=options.cells, knots=None, max_jacobians=options.max_jacobians)
    if options.fleet:
        return run_fleet(options, choices, folder, Progress(options.quiet))
    bench, actuator = _bench_and_start(options)
    extra = effect_parameters(actuator)
    refuse_profile(options, free_parameters(bench, actuator or bench.actuator(), extra))
    recordings = load_recordings(options.recordings, bench)
    checks, refused = load_checks(options.check, bench)
    refuse_copies(recordings, checks, bench)
    with Progress(options.quiet) as progress:
        result = fit(recordings, bench, actuator=actuator, extra=extra, choices=choices, progress=progress)
        (more, text), stopped = ({}, ""), None
        try:
            more, text = intervals(result, options, folder, progress)
        except (MagjaxError, KeyboardInterrupt) as error:  # the fit itself is done and is kept
            stopped = error
        content = result.as_dict() | more
        rows = check_errors(result.actuator, result.actuator, checks, bench) if checks else []
        content["check"] = Foreteller(checks, result).beside(rows, result)
        content["check_left_out"] = list(refused)
        table = None
        if options.recipe:
            from fitting.recipe import recipe_beside

            progress("T&B's recipe")
            table = recipe_beside(result, recordings)
            content["recipe"] = table.as_dict()
        if folder:
            from fitting.report import write_fit

            write_fit(folder, result, recordings, content, _reproduce("fit", arguments), progress, checks)
    if options.json:
        print(as_json(content))
    else:
        print(result)
        if table:
            print(f"\n{table}")
        if text:
            print(f"\n{text}")
        for row in content["check"]:
            after, noise, expected = (sized(row["unit"], row[k] or 0.0) for k in ("rms_after", "noise_rms", "expected_rms"))
            expected = f", expected {expected}" if row["expected_rms"] else ""
            print(f"  check {Path(row['file']).name}: rms {after} (noise {noise}{expected})")
        if note := beyond_text(content["check"]):
            print(f"  {note}")
        for why in refused:
            print(f"  left out of the checks: {why}")
        if folder:
            print(f"\nresults in {_written(folder, 'report.html', 'fit.json', 'model.json')}")
    if stopped is not None:
        raise stopped
    return 130 if result.solution.interrupted else 0 if result.converged else 4


def run_diagnose(arguments) -> int:
    """magjax diagnose."""
    p = _common("diagnose", "Say what physics the model leaves out: where, what, how much better with it, what to record next.",
                "magjax diagnose rec_*.csv --bench aa-050h --check check_*.csv --out result")  # fmt: skip
    p.add_argument(
        "--calibration",
        nargs="+",
        action="extend",
        default=[],
        help="the sensor moved by a known amount: files with reference_m beside the reading",
    )
    p.add_argument("--only", nargs="+", action="extend", default=[], metavar="EFFECT",
                   help="ask for these effects alone (`docs/effects.md` has the names); drift, heat and hum are told in any case")  # fmt: skip
    p.add_argument("--minutes", type=minutes, default=MINUTES,
                   help=f"limit, from the start: it ends with what it has found, the search for effects after four fifths; inf: none (default {MINUTES:g})")  # fmt: skip
    p.add_argument("--placebo", type=int, default=0, metavar="N",
                   help="search N simulations of the final model for what they do not lack: how often the search cries wolf (some seconds each, more where the screening alarms)")  # fmt: skip
    add_where(p, "the placebo's finished searches")
    options = p.parse_args(arguments)
    check_placebo(options)
    prepare_jax()
    from magjax.effects import refuse_unknown
    from magjax.errors import RecordingError
    from magjax.readers import load_calibrations, load_checks, load_sound, refuse_absent_and_twice, refuse_copies

    bench, actuator = _bench_and_start(options)
    folder = output_folder(options.out)
    if bench.output == "strain" and options.placebo:
        raise ConfigurationError("--placebo simulates recordings, and strain curves have a law instead; leave it out")
    refuse_unknown(options.only)
    if bench.output == "strain" and options.only:
        raise ConfigurationError("--only asks for effects, and strain curves have a law instead; leave it out")
    refuse_absent_and_twice(options.recordings, options.check, options.calibration)
    if bench.output == "strain":
        return _diagnose_strain(options, bench, folder)
    from fitting.diagnose import diagnose
    from fitting.diagnosis import unusable
    from fitting.setup import Choices
    from fitting.still import moving_and_still

    recordings, checks, stopped, shown = [], [], None, None
    try:
        recordings, errors = load_sound(options.recordings, bench)
        if errors:
            raise errors[0]
        checks, refused = load_checks(options.check, bench)
        refuse_copies(recordings, checks, bench)
        with Progress(options.quiet) as progress:
            found = diagnose(recordings, bench, check=checks, calibration=load_calibrations(options.calibration, bench), actuator=actuator,
                             choices=Choices(max_jacobians=options.max_jacobians, only=tuple(options.only)), progress=progress,
                             minutes=options.minutes).without_checks(refused)  # fmt: skip
            if options.placebo and found.verdict != "data_problem":
                try:
                    found = with_placebo(found, [*moving_and_still(recordings, bench)[0], *found.parted(checks)[0]], options, progress)
                except (MagjaxError, KeyboardInterrupt) as error:  # the diagnosis itself is done and is kept
                    stopped = error
    except RecordingError as error:
        found, shown = unusable(errors or [error], recordings if errors else ()), error.shown
    except KeyboardInterrupt as stop:
        return _kept_plain(getattr(stop, "plain", None), recordings, folder, arguments)
    content = found.as_dict()
    if folder:
        from fitting.report import write_diagnosis

        with Progress(options.quiet) as progress:
            write_diagnosis(folder, found, recordings, content, _reproduce("diagnose", arguments), checks, progress, bench, shown)
    if options.json:
        print(as_json(content))
    else:
        print(found)
        for row in found.candidates[:8]:
            seen = f"visible from {row.smallest_visible:.3g}" if row.tried_at is None else f"tried at {row.tried_at:.3g}"
            print(f"  {row.name:26s} z = {row.z:8.1f}   {seen}")
        if found.placebo:
            print(placebo_text(found.placebo))
        if folder:
            print(f"\nresults in {folder} (report.html, diagnosis.json)")
    if stopped is not None:
        raise stopped
    return 3 if found.verdict == "data_problem" else 0


def _kept_plain(plain, recordings, folder, arguments) -> int:
    """What an interrupted diagnosis leaves: the plain fit, if it was there."""
    if plain is None or folder is None:
        print("magjax diagnose: interrupted; nothing was reached that could be kept", file=sys.stderr)
        return 130
    from fitting.report import write_fit

    content = {**plain.as_dict(), "check": [], "check_left_out": []}
    write_fit(folder, plain, recordings, content, _reproduce("diagnose", arguments))
    kept = _written(folder, "report.html", "fit.json", "model.json")
    print(f"magjax diagnose: interrupted; the plain fit is kept in {kept}", file=sys.stderr)
    return 130


def _diagnose_strain(options, bench, folder) -> int:
    """Strain curves have a law, not a history: a diagnosis of their own."""
    from fitting.result import write_atomically
    from fitting.strain_law import diagnose_strain, draw_strain, load_curves, strain_verdict

    curves = load_curves(options.recordings, bench)
    with Progress(options.quiet) as progress:
        progress("laws of magnetostriction, each curve left out in turn")
        content = strain_verdict(curves)
        if folder:
            law, tried = diagnose_strain(curves)
            write_atomically(folder / "diagnosis.json", json.dumps(content, indent=1))
            draw_strain(curves, law, tried["square", None], folder / "strain.png")
    if options.json:
        print(as_json(content))
    else:
        print(f"{content['verdict']}: {content['message']}")
        for row in content["laws"][:8]:
            print(
                f"  {row['law']:8s} {row['variable'] or 'no variable':14s} rms {row['rms']:.3g}, on curves left out {row['held_out_rms']:.3g}"
            )
        if folder:
            print(f"\nresults in {folder} (diagnosis.json, strain.png)")
    return 0


def run_demo(arguments) -> int:
    """magjax demo."""
    p = parser(
        "demo",
        "Invent a bench with concealed physics, record it with noise, fit it, diagnose it, write the report.",
        "magjax demo --out demo",
    )
    p.add_argument("--out", default="magjax-demo", help="folder for recordings and results (default magjax-demo)")
    p.add_argument(
        "--paper",
        action="store_true",
        help="instead: T&B's loops with their constants, and their recipe for R_eddy and xi (Figs. 6-8)",
    )
    options = p.parse_args(arguments)
    prepare_jax()
    folder = output_folder(options.out)
    if options.paper:
        from fitting.paper import run_paper

        with Progress(options.quiet):
            content = run_paper(folder, options.seed)
        print(as_json(content) if options.json else f"{content['message']}\n\nresults in {folder} (paper.html, paper.json)")
        return 0
    from fitting.demo import run_demo as demo

    with Progress(options.quiet) as progress:
        text, content = demo(folder, options.seed, progress)
    print(as_json(content) if options.json else text)
    return 0


def run_report(arguments) -> int:
    """magjax report."""
    p = parser("report", "Build report.html of a result folder again.", "magjax report result")
    p.add_argument("folder", help="a folder that magjax fit or diagnose wrote")
    options = p.parse_args(arguments)
    from fitting.report import rebuild

    with Progress(options.quiet) as progress:
        page = rebuild(Path(options.folder), progress)
    print(json.dumps({"report": str(page)}) if options.json else f"wrote {page}", file=sys.stdout)
    return 0
