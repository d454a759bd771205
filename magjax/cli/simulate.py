"""Commands simulate and sweep."""

import dataclasses

from magjax.errors import ConfigurationError
from magjax.words import sized

from .runtime import Progress, as_json, output_folder, parser, prepare_jax, refuse_overwriting, told
from .scale import add_where, executor_of

MOST_SAMPLES = 1_000_000  # of a period
MOST_VALUES = 1_000_000  # along one axis of a sweep


def run(command: str, arguments: list[str]) -> int:
    """Run one of the commands of this module."""
    return {"simulate": run_simulate, "sweep": run_sweep}[command](arguments)


def _actuator(options):
    if options.model is not None:
        from magjax.model_file import load_model

        if options.bench:
            raise ConfigurationError("--bench and --model: a model holds its bench; give one of the two")
        return load_model(options.model)
    from magjax.bench import load_bench

    bench = told(load_bench(options.bench or "aa-050h"))
    return bench.actuator(), bench


def _target(path):
    from pathlib import Path

    path = Path(path)
    if path.is_dir():
        raise ConfigurationError(f"{path}: is a folder; give a file in it, as in --out {path / 'simulation.nc'}")
    if path.suffix.lower() != ".nc":
        raise ConfigurationError(f"--out {path}: every signal is written, as NetCDF; name it {path.with_suffix('.nc')}")
    output_folder(path.parent)
    return path


def _drive_of(file, bench):
    """(drive, dt, periodic) of a file that holds time and the drive at least; what else it holds is left aside.

    Whole periods are led to their steady state; anything else runs once from the start state.
    """
    from magjax.recording import load_recordings

    # what is read does not matter here: the drive stands for it, so that no reading need be there
    found = load_recordings([file], dataclasses.replace(bench, output=bench.drive))
    if len(found) > 1:
        raise ConfigurationError(f"--drive {file}: holds {len(found)} recordings ({found[0].name}, ...); give a file with one")
    recording, per = found[0], found[0].period_samples()
    whole = per is not None and abs(recording.n_samples - per * round(recording.n_samples / per)) < 0.5
    return recording.channels[bench.drive], recording.dt, whole


def _options(command, text, example):
    p = parser(command, text, example)
    p.add_argument("--bench", help="bench file (TOML) or a built-in name (default aa-050h)")
    p.add_argument("--model", help="a fitted result folder")
    return p


def run_simulate(arguments) -> int:
    """magjax simulate."""
    p = _options("simulate", "Simulate the chain for a biased sine or for the drive of a file; every signal goes to NetCDF.",
                 "magjax simulate --model result --frequency 50 --amplitude 0.8 --offset 0.1 --out run.nc")  # fmt: skip
    p.add_argument(
        "--drive",
        help="a file whose drive is applied: time and current (or field, voltage) suffice; whole periods are led to their steady state",
    )
    p.add_argument("--frequency", type=float, default=50.0, help="Hz")
    p.add_argument("--amplitude", type=float, default=0.5, help="in the unit of the drive: A, A/m of a known field, V of a stack")
    p.add_argument("--offset", type=float, default=0.0, help="in the same unit")
    p.add_argument("--samples", type=int, default=1000, help="samples a period")
    p.add_argument("--out", default="simulation.nc", help="NetCDF file")
    options = p.parse_args(arguments)
    import numpy as np

    prepare_jax()
    actuator, bench = _actuator(options)
    path = _target(options.out)
    from magjax.plausibility import si_unit
    from magjax.simulate import MOST_PERIODS, TOLERANCE, signals_dataset, simulate
    from magjax.writers import write_dataset

    if options.drive:
        refuse_overwriting(path, options.drive)
        drive, dt, periodic = _drive_of(options.drive, bench)
    else:
        if not 20 <= options.samples <= MOST_SAMPLES or not 0 < options.frequency < np.inf:
            raise ConfigurationError(f"give --frequency above zero and --samples of 20 to {MOST_SAMPLES}")
        phase = 2 * np.pi * np.arange(options.samples) / options.samples
        drive = options.offset + options.amplitude * np.sin(phase)
        dt, periodic = 1 / (options.frequency * options.samples), True
    with Progress(options.quiet):
        signals = simulate(actuator, drive, dt, periodic=periodic)
        data = signals_dataset(signals, actuator, bench.name)
        write_dataset(path, data)
    stroke, settled = float(np.ptp(np.asarray(signals.reading))), not float(signals.unsettled) > TOLERANCE
    text = f"peak to peak {sized(si_unit(actuator.output), stroke, digits=4)}; wrote {path}"
    if not settled:
        text += f"; not settled: the last two of {MOST_PERIODS} periods still differ by {float(signals.unsettled):.1e} of the peak to peak"
    print(as_json({"file": str(path), "peak_to_peak": stroke, "settled": settled}) if options.json else text)
    return 0 if settled else 4


def _values(text):
    import numpy as np

    try:
        if ":" in text:
            low, high, count = text.split(":")
            if not 1 <= int(count) <= MOST_VALUES:
                raise ConfigurationError(f'"{text}" asks for {count} values along one axis; give 1 to {MOST_VALUES:,}')
            return np.linspace(float(low), float(high), int(count))
        return np.asarray([float(v) for v in text.split(",")])
    except ValueError:
        raise ConfigurationError(f'"{text}" is no list of values; write 10,20,50 or 10:300:30 (low:high:count)') from None


def run_sweep(arguments) -> int:
    """magjax sweep."""
    p = _options("sweep", "Steady states over frequencies x amplitudes x offsets, to NetCDF.",
                 "magjax sweep --frequencies 10:300:30 --amplitudes 0.1:0.8:8 --out sweep.nc")  # fmt: skip
    p.add_argument("--frequencies", default="10:300:30", help="Hz: a list or low:high:count")
    p.add_argument("--amplitudes", default="0.2,0.5,0.8", help="in the unit of the drive: A, A/m of a known field, V of a stack")
    p.add_argument("--offsets", default="0", help="in the same unit")
    p.add_argument("--out", default="sweep.nc", help="NetCDF file")
    add_where(p, "finished chunks")
    options = p.parse_args(arguments)
    import numpy as np

    executor = executor_of(options)
    prepare_jax(many=True)
    actuator, _ = _actuator(options)
    path = _target(options.out)
    from magjax.simulate import MOST_PERIODS, sweep
    from magjax.writers import write_dataset

    grid = [_values(text) for text in (options.frequencies, options.amplitudes, options.offsets)]
    with Progress(options.quiet) as progress:
        data = sweep(actuator, *grid, executor=executor, checkpoint=options.checkpoint, progress=progress)
        write_dataset(path, data)
    count = int(np.prod(list(data.sizes.values())))
    left = int((data.unsettled > data.tolerance).sum())
    text = f"{count} steady states; wrote {path}"
    if left:
        text += f"; {left} not settled after {MOST_PERIODS} periods: see the variable unsettled"
    print(as_json({"file": str(path), "points": count, "unsettled": left}) if options.json else text)
    return 4 if left else 0
