"""Command investigate."""

import json
import shlex
import sys

from .acquire import _record_options, campaign
from .fit import MINUTES
from .runtime import parser, prepare_jax

STATUS = {"settled": 0, "interrupted": 130, "device": 5, "no usable recording": 3}


def run(_command: str, arguments: list[str]) -> int:
    """magjax investigate."""
    p = parser("investigate", "Record, fit, diagnose, record what the diagnosis asks for, until the verdict is settled or the budget is spent. "
               "A second call with the same --out goes on.", "magjax investigate /dev/ttyACM0 --bench my-bench.toml --out study")  # fmt: skip
    p.add_argument("port", help="serial port, or socket://host:port")
    _record_options(p)
    p.add_argument("--plan", help="study file (TOML) for the first recordings (default: six sines)")
    p.add_argument("--recordings", type=int, default=20, help="budget: recordings (default 20)")
    p.add_argument("--minutes", type=float, default=30.0, help=f"budget: minutes (default 30); the search of each diagnosis ends after {MINUTES:g}")
    options = p.parse_args(arguments)
    from magjax.acquire.campaign import read_plan
    from magjax.acquire.display import Live
    from magjax.acquire.investigation import Budget, Investigation

    plan = read_plan(options.plan) if options.plan else None
    quiet = options.quiet or options.json
    with Live(quiet) as live:
        made = campaign(
            options, arguments, "investigate", live, lambda text: None if quiet else print(text, file=sys.stderr, flush=True)
        )
        if plan is not None:
            made.settings = plan.settings
        state = Investigation(
            made, analysis(made.bench, made.folder, options, live), Budget(options.recordings, options.minutes), plan
        ).run()
    ended = state["ended"]
    if options.json:
        print(json.dumps(state))
    else:
        print(f"{ended['how']}: {ended['message']}\nresults in {made.folder} (report.html, investigation.json)")
    verdict = ended["verdict"]
    return STATUS.get(ended["how"], 3 if verdict == "data_problem" else 4)


def analysis(bench, folder, options, live):
    """Fit and diagnosis as the investigation calls them; `live` shows how far they are."""

    def progress(text, step=0, chi2=None):
        live.tell(f"{text}{f': step {step}' if step else ''}{'' if chi2 is None else f', chi2/N = {chi2:.4g}'}")

    def analyse(files, checks, number):
        live.tell("reading and compiling")
        prepare_jax()
        from fitting.diagnose import diagnose
        from fitting.diagnosis import unusable
        from fitting.report import write_diagnosis
        from magjax.errors import RecordingError
        from magjax.readers import load_checks, load_sound

        from .runtime import output_folder

        recordings, held, shown = [], [], None
        try:
            recordings, errors = load_sound(files, bench)
            if errors:
                raise errors[0]
            held, refused = load_checks(checks, bench)
            found = diagnose(recordings, bench, check=held, progress=progress, minutes=MINUTES).without_checks(refused)
        except RecordingError as error:
            found, shown = unusable(errors or [error], recordings if errors else ()), error.shown
        content = found.as_dict()
        place = output_folder(folder / f"diagnosis_{number + 1}")
        write_diagnosis(
            place,
            found,
            recordings,
            content,
            shlex.join(map(str, ["magjax", "diagnose", *files, "--bench", options.bench, *(["--check", *checks] if checks else [])])),
            held,
            bench=bench,
            shown=shown,
        )
        return json.loads(json.dumps(content))

    return analyse
