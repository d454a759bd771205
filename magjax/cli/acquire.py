"""Commands ports, emulate, record."""

import json
import os
import shlex
import sys
from pathlib import Path

from magjax.errors import ConfigurationError

from .runtime import parser


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    return {"ports": run_ports, "emulate": run_emulate, "record": run_record}[command](arguments)


def run_ports(arguments) -> int:
    """magjax ports."""
    p = parser("ports", "Serial ports of this machine, with the identity by which a device is found again.", "magjax ports")
    options = p.parse_args(arguments)
    from magjax.acquire.link import list_ports

    found = list_ports()
    if options.json:
        print(json.dumps(found))
    else:
        print(
            "\n".join(f"{c['port']:24s} {c['description']:32s} {c['identity']}" for c in found)
            or "no serial port found; is the device plugged in?"
        )
    return 0


def driven_by_current(bench):
    """The bench, where its device is driven by a current; else the error that says what to do instead."""
    if bench.drive == "voltage":
        raise ConfigurationError(
            f"bench {bench.name}: is driven by a voltage, these devices by a current; record it with your own instruments as CSV "
            "(time_s, voltage_V, displacement_um) and give the files to magjax check, fit and diagnose"
        )
    return bench


def _hidden(words) -> dict:
    """Effect name -> parameters, from words such as sensor_lag:tau=1e-4,order2=0.5."""
    found = {}
    for word in words:
        name, _, rest = word.partition(":")
        found[name] = {}
        for pair in filter(None, rest.split(",")):
            key, _, value = pair.partition("=")
            try:
                found[name][key] = float(value)
            except ValueError:
                raise ConfigurationError(
                    f'--hide "{word}": write EFFECT:PARAMETER=VALUE, for instance sensor_lag:tau=1e-4'
                ) from None
    return found


def run_emulate(arguments) -> int:
    """magjax emulate."""
    p = parser("emulate", "A bench as a real device on a pseudo-terminal or TCP port: the model, with concealed effects, noise, counts and faults.",
               "magjax emulate --bench aa-050h --hide sensor_lag:tau=1e-4 --fault drop=1e-5")  # fmt: skip
    p.add_argument(
        "--bench", default="aa-050h", help="bench file (TOML) or a built-in name; plain: no physics, for trying the link"
    )
    p.add_argument(
        "--hide",
        action="append",
        default=[],
        metavar="EFFECT[:NAME=VALUE,...]",
        help="conceal an effect of the catalogue (again for more)",
    )
    p.add_argument(
        "--as-stated", action="store_true", help="keep the bench file's constants and density instead of inventing others"
    )
    p.add_argument("--fault", action="append", default=[], metavar="NAME=VALUE",
                   help="drop, flip, merge, duplicate (probabilities), zeros, reset, stall, unplug, wrap, drift, shift, at")  # fmt: skip
    p.add_argument("--tcp", type=int, metavar="PORT", help="listen on this TCP port (0: a free one) instead of a pseudo-terminal")
    p.add_argument("--link", help="name that points to the pseudo-terminal (NAME1 after it was unplugged)")
    p.add_argument("--fast", action="store_true", help="as fast as it goes instead of real time")
    p.add_argument("--baud", type=float, help="pace the line: bits a second (ten a byte)")
    p.add_argument("--rate-max", type=float, default=2e5, help="fastest sampling, Hz (default 200000)")
    p.add_argument("--frame", type=int, default=64, help="samples a frame (default 64)")
    p.add_argument(
        "--watchdog", type=float, default=2.0, help="s of the host's silence after which the drive goes to zero (default 2)"
    )
    p.add_argument("--exact", action="store_true", help="no noise")
    options = p.parse_args(arguments)
    return _emulate(options)


def _emulate(options) -> int:
    from magjax.acquire.device import Device
    from magjax.acquire.emulator import Emulator, PtyLine, TcpLine
    from magjax.acquire.faults import read_faults

    ranges = {
        "--frame": (options.frame, 1, 4096),
        "--rate-max": (options.rate_max, 1e-3, 4e6),
        "--watchdog": (options.watchdog, 1e-3, 1e6),
    }
    if options.baud is not None:
        ranges["--baud"] = (options.baud, 1.0, 1e10)
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise ConfigurationError(f"{name} {value:g}: give {low:g} to {high:g}")
    faults = read_faults(options.fault, options.seed)
    response, limit = _response(options, faults)
    wrapping = {"first_seq": 2**32 - 20, "clock_us": 2**32 - 300_000, "clock_bits": 32} if faults.wrap else {}
    device = Device(response, name=f"emulated {options.bench} {options.seed}", rate_max=options.rate_max, frame_samples=options.frame,
                    watchdog_s=options.watchdog, drive_limit=limit, drift_ppm=faults.drift, noise=not options.exact, seed=options.seed,
                    **wrapping)  # fmt: skip
    line = TcpLine(options.tcp, options.baud) if options.tcp is not None else PtyLine(options.link, options.baud)
    text = (
        json.dumps({"port": line.name, "device": device.name}) if options.json else f"{device.name} at {line.name}; Ctrl-C ends it"
    )
    print(text, flush=True)
    import signal

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        Emulator(device, line, faults, options.fast).run()
    except KeyboardInterrupt:
        return 0
    return 0


def _response(options, faults):
    from magjax.acquire.response import BenchResponse, PlainResponse

    hidden = _hidden(options.hide)
    if options.bench == "plain":
        if hidden:
            raise ConfigurationError("--bench plain has no physics to hide an effect in; give a bench")
        return PlainResponse(options.exact), 1.5
    from magjax.bench import load_bench

    bench = driven_by_current(load_bench(options.bench))
    actuator = None
    if not options.as_stated:
        from .runtime import prepare_jax

        prepare_jax()
        from fitting.demo import concealed_actuator

        actuator = concealed_actuator(bench)
    return BenchResponse(bench, hidden, actuator=actuator, shift=faults.shift), 1.1 * float(bench.limits.get("current_A", 1.0))


def provenance(command, arguments, bench) -> dict:
    """What every log's header states beside the device."""
    import datetime

    from magjax import __version__

    stamp = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = "magjax " + command + " " + " ".join(shlex.quote(a) for a in arguments)
    return {"bench": bench, "date": stamp, "command_line": line, "magjax": __version__}


def _record_options(p):
    p.add_argument("--bench", default="aa-050h", help="bench file (TOML) or a built-in name: its limits hold")
    p.add_argument("--out", required=True, help="log to write (.mjlog), or the folder of a plan's recordings")
    p.add_argument("--baud", type=int, default=2_000_000, help="baud rate (default 2000000)")
    p.add_argument("--amplifier", metavar="PORT", help="set up a SCPI amplifier there, and switch it off at the end")
    p.add_argument("--limit", type=float, help="current limit, A (default: the bench's)")
    p.add_argument("--durable", action="store_true", help="acknowledge samples only after they are on the disk (fsync)")
    p.add_argument("--give-up", type=float, default=15.0, help="s of silence after which the recording ends (default 15)")


def run_record(arguments) -> int:
    """magjax record."""
    p = parser("record", "Record a device, crash-safe: a drive of its own, or the whole list of a study file.",
               "magjax record /dev/ttyACM0 --frequency 50 --amplitude 0.5 --out run.mjlog --export run.nc")  # fmt: skip
    p.add_argument("port", help="serial port, or socket://host:port")
    _record_options(p)
    p.add_argument("--plan", help="study file (TOML): a list of drives")
    p.add_argument("--frequency", type=float, default=50.0, help="Hz (default 50)")
    p.add_argument("--amplitude", type=float, default=0.5, help="A (default 0.5)")
    p.add_argument("--offset", type=float, default=0.0, help="A (default 0)")
    p.add_argument("--samples", type=int, default=500, help="samples a period (default 500)")
    p.add_argument("--periods", type=int, default=8, help="settled periods to keep (default 8); 0: until Ctrl-C or --seconds")
    p.add_argument("--settle", type=int, default=4, help="periods before them (default 4)")
    p.add_argument("--seconds", type=float, help="duration limit, s")
    p.add_argument("--no-drive", action="store_true", help="record only")
    p.add_argument("--rate", type=float, help="samples/s with --no-drive")
    p.add_argument(
        "--text",
        nargs="?",
        const="",
        metavar="COLUMNS",
        help="text-line device; COLUMNS such as seq,t_us,current_mA,displacement_um",
    )
    p.add_argument("--resume", action="store_true", help="append to a log that exists")
    p.add_argument("--export", help="write the recording to this file, too (.nc, .csv, .mat, .parquet)")
    options = p.parse_args(arguments)
    if options.plan:
        return _run_plan(options, arguments)
    return _run_single(options, arguments)


def _run_single(options, arguments) -> int:
    from magjax.acquire.display import Live
    from magjax.acquire.export import export_log, known_ending
    from magjax.acquire.link import writable
    from magjax.acquire.order import Order
    from magjax.acquire.process import record
    from magjax.bench import load_bench

    bench = driven_by_current(load_bench(options.bench))
    path = Path(options.out)
    writable(path)
    if path.suffix.lower() != ".mjlog":
        raise ConfigurationError(
            f"{path}: a log is read by its ending; write {path.with_suffix('.mjlog').name} (and --export for others)"
        )
    if path.exists() and not options.resume:
        raise ConfigurationError(f"{path}: exists already; choose another name or add --resume")
    if options.export:
        known_ending(Path(options.export))
        writable(options.export)
    limit = bench.limits.get("current_A") if options.limit is None else options.limit
    order = Order(options.port, os.fspath(path), baud=options.baud, limit_A=limit, max_s=options.seconds, durable=options.durable, text=options.text,
                  amplifier=options.amplifier, give_up_s=options.give_up, header=provenance("record", arguments, bench.name))  # fmt: skip
    if options.text is not None:
        order.rate = options.rate or 0.0
    elif options.no_drive:
        order.rate, order.samples = 1e4 if options.rate is None else options.rate, 0
    else:
        _sine(order, options)
    if options.resume:
        _resume(order)
    order.check_limit()
    with Live(options.quiet or options.json) as live:
        summary = record(order, live)
    if options.export and summary.get("received"):
        summary["exported"] = [str(f) for f in export_log(path, options.export)]
    return finish(summary, options, "record")


def campaign(options, arguments, command, live, say):
    """The campaign that options describe."""
    from magjax.acquire.campaign import SETTINGS, Campaign
    from magjax.bench import load_bench

    from .runtime import output_folder

    bench = driven_by_current(load_bench(options.bench))
    limit = bench.limits.get("current_A") if options.limit is None else options.limit
    if limit is not None and not 0 < limit < float("inf"):
        raise ConfigurationError(f"--limit = {limit:g}; give a number above zero")
    return Campaign(options.port, bench, output_folder(options.out), limit, dict(SETTINGS), provenance(command, arguments, bench.name),
                    options.baud, options.durable, options.give_up, say, live, options.amplifier)  # fmt: skip


def _run_plan(options, arguments) -> int:
    from magjax.acquire.campaign import entries, read_plan
    from magjax.acquire.display import Live

    _refuse_beside_plan(options)
    plan = read_plan(options.plan)
    quiet = options.quiet or options.json
    with Live(quiet) as live:
        made = campaign(options, arguments, "record", live, lambda text: None if quiet else print(text, file=sys.stderr))
        made.settings = plan.settings
        made.check_limits(entries(plan))
        found = entries(plan, made.rate_max())
        rows = made.run(found)
    status = max((r["status"] for r in rows), key=lambda s: (s in (5, 130), s))
    good = sum(r["status"] == 0 for r in rows)
    if options.json:
        print(json.dumps({"recordings": rows, "good": good}))
    else:
        for row in rows:
            print(f"  {row['name']:32s} {'good' if not row['problems'] else row['problems'][0]}")
        rest = "" if len(rows) == len(found) else "; the same command goes on where it ended"
        print(f"{good} of {len(found)} recordings are fit to use, in {options.out}{rest}")
    return status


def _refuse_beside_plan(options):
    """A plan has its own drives and exports: what it does not heed is no silent option."""
    given = {"--no-drive": options.no_drive, "--text": options.text is not None, "--export": options.export, "--seconds": options.seconds,
             "--rate": options.rate}  # fmt: skip
    for name, value in given.items():
        if value:
            raise ConfigurationError(f"{name} does nothing beside --plan, which says what is recorded; leave one of the two out")


def _sine(order, options):
    if not options.frequency > 0 or options.samples < 16 or options.periods < 0 or options.settle < 0:
        raise ConfigurationError("give --frequency above zero, --samples of 16 or more, --periods and --settle of zero or more")
    order.rate = options.frequency * options.samples
    order.samples, order.settle_samples = options.periods * options.samples, options.settle * options.samples
    order.drive = {
        "kind": "sine",
        "samples": options.samples,
        "periods": 0,
        "amplitude": options.amplitude,
        "offset": options.offset,
        "factor": 1.0,
    }
    drive = f"sine {options.frequency:g} Hz, {options.amplitude:g} A about {options.offset:g} A"
    order.about = {"frequency_Hz": options.frequency, "settle_samples": order.settle_samples, "drive": drive}
    order.loop_samples = options.samples


def _resume(order):
    from magjax.acquire.log import Log

    if not Path(order.path).exists():
        raise ConfigurationError(f"{order.path}: no such log to resume; leave --resume out")
    try:
        log = Log(order.path)
    except OSError as error:
        raise ConfigurationError(f"{order.path}: cannot be read ({error.strerror}); choose another --out") from None
    order.resume, order.resume_header = True, log.header
    order.resume_from = max([s[0] for s in log.pieces] + [e["segment"] for e in log.events if "segment" in e], default=-1)


def finish(summary, options, command) -> int:
    """Print how a recording ended; its exit status."""
    status = summary["status"]
    if options.json:
        print(json.dumps(summary))
    elif summary["state"] == "refused":
        print(f"magjax {command}: {summary['reason']}", file=sys.stderr)
    else:
        text = f"{summary['reason']}: {summary.get('received', 0)} samples received, {summary.get('lost', 0)} lost"
        if "sent" in summary:
            text += f" of {summary['sent']} sent" if summary["tail_known"] else " (tail unknown)"
        text += f"; drive at zero: {summary.get('drive_at_zero', 'by its watchdog')}; {summary['path']}"
        if "exported" in summary:
            text += f", exported to {', '.join(summary['exported'])}"
        print(text, file=sys.stderr if status else sys.stdout)
    return status
