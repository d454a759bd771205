"""What commands that scale share: where the work runs, the checkpoint, intervals of a fit, fleets."""

import json

from magjax.errors import ConfigurationError

PROFILE = ".profile"  # a bootstrap and a profile are two jobs: each has its own checkpoint


def add_where(p, what: str) -> None:
    """Options for where the chunks run; `what` the checkpoint keeps."""
    p.add_argument("--workers", type=int, metavar="N", help="processes that share the work (default: this process alone)")
    p.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler that shares out the work (tcp://host:8786)")
    p.add_argument("--checkpoint", metavar="FILE", help=f"keep {what} in this file; a command that was killed goes on from it")


def add_intervals(p) -> None:
    """Options of `fit` that ask for many fits."""
    p.add_argument("--bootstrap", type=int, metavar="N", help="intervals from N refits of recordings drawn again")
    p.add_argument(
        "--bootstrap-kind",
        choices=("parametric", "blocks"),
        default="parametric",
        help="noise from its model, or from the recorded periods",
    )
    p.add_argument("--profile", metavar="NAMES", help="profile-likelihood intervals: R_eddy,xi or all")
    p.add_argument(
        "--fleet", nargs="+", action="extend", metavar="DIR", help="one fit a folder of recordings; a table of all in --out"
    )
    add_where(p, f"what the bootstrap or the fleet has done (the profile beside it, FILE{PROFILE})")


def executor_of(options):
    """The `executor=` that the options name."""
    if options.workers is not None and options.scheduler:
        raise ConfigurationError("give --workers or --scheduler, not both")
    if options.workers is not None and options.workers < 1:
        raise ConfigurationError(f"--workers {options.workers}; give 1 or more")
    if options.scheduler:
        return f"dask:{options.scheduler}"
    return f"processes:{options.workers}" if options.workers is not None else None


def check_intervals(options) -> None:
    """Refuse what cannot work before the fit takes its time."""
    executor_of(options)
    if options.bootstrap is not None and options.bootstrap < 2:
        raise ConfigurationError(f"--bootstrap {options.bootstrap}; give 2 or more, 200 for 95 % intervals")
    if options.fleet and (options.bootstrap or options.profile or options.model):
        raise ConfigurationError("--fleet goes with neither --bootstrap, --profile nor --model; fit one folder by itself for these")
    if options.fleet and options.check:
        raise ConfigurationError(
            "--fleet takes no --check; recordings whose names begin with check_ take no part in their folder's fit"
        )
    if options.fleet and options.recordings:
        raise ConfigurationError(f"--fleet takes folders after it and no recordings beside it ({options.recordings[0]})")
    if not options.fleet and not options.recordings:
        raise ConfigurationError("give recordings, or --fleet with one folder an actuator; see magjax fit --help")


def refuse_profile(options, free) -> None:
    """Refuse a --profile of names that are not among the `free` parameters before the fit takes its time."""
    if options.profile and options.profile != "all":
        from fitting.scale.profile import full_names

        full_names(options.profile.split(","), free)


def intervals(result, options, folder, progress):
    """Bootstrap and profile of a fit as asked: (entries for fit.json, text)."""
    from magjax.writers import write_dataset

    content, texts = {}, []
    executor = executor_of(options)
    if options.bootstrap is not None:
        from fitting.scale import bootstrap_intervals

        found = bootstrap_intervals(
            result,
            options.bootstrap,
            kind=options.bootstrap_kind,
            seed=options.seed,
            executor=executor,
            checkpoint=options.checkpoint,
            progress=progress,
        )
        content["bootstrap"] = found.as_dict()
        texts += [str(found), f"  {found.outcome}"]
        if folder:
            write_dataset(folder / "bootstrap.nc", found.dataset())
    if options.profile:
        from fitting.scale import profile_intervals

        names = None if options.profile == "all" else options.profile.split(",")
        kept = f"{options.checkpoint}{PROFILE}" if options.checkpoint else None
        found = profile_intervals(result, names, executor=executor, checkpoint=kept, progress=progress)
        content["profile"] = found.as_dict()
        texts += [str(found), f"  {found.outcome}"]
    return content, "\n".join(texts)


def check_placebo(options) -> None:
    """Refuse what cannot work before the diagnosis takes its time."""
    executor_of(options)
    if options.placebo < 0:
        raise ConfigurationError(f"--placebo {options.placebo}; give 1 or more, 20 to see false alarms of one in ten")
    if not options.placebo and (options.workers or options.scheduler or options.checkpoint):
        raise ConfigurationError("--workers, --scheduler and --checkpoint serve the placebo; add --placebo 20")


def with_placebo(found, recordings, options, progress):
    """The diagnosis with how often the same search cries wolf on simulations of its final model."""
    import dataclasses

    from fitting.placebo import final_model, placebo

    more = {"seed": options.seed, "executor": executor_of(options), "checkpoint": options.checkpoint, "progress": progress}
    return dataclasses.replace(found, placebo=placebo(final_model(found), recordings, options.placebo, **more))


def placebo_text(found) -> str:
    """The placebo in one line."""
    named = ", ".join(f"{name} {count}" for name, count in found["named"].items())
    return (
        f"  placebo: {found['false_alarms']} of {found['runs']} searches of simulations that lack nothing cried wolf"
        f"{f' ({named})' if named else ''}; the screening alarmed in {found['screening_alarms']}, highest z = {max(found['highest_z']):.1f}"
    )


def run_fleet(options, choices, folder, progress) -> int:
    """magjax fit --fleet: fleet.csv and fleet.nc in the folder, a result folder for each actuator in it."""
    from fitting.result import write_atomically
    from fitting.scale import fit_fleet
    from magjax.writers import write_dataset

    with progress:
        fleet = fit_fleet(
            options.fleet, options.bench, choices=choices, executor=executor_of(options), checkpoint=options.checkpoint,
            progress=progress, models=bool(folder or options.checkpoint),
        )  # fmt: skip
    if folder:
        write_atomically(folder / "fleet.csv", fleet.csv())
        write_dataset(folder / "fleet.nc", fleet.dataset())
        for row in fleet.rows:
            if row["status"] != "failed":
                own = folder / row["name"]
                own.mkdir(exist_ok=True)
                write_atomically(own / "fit.json", json.dumps(row["fit"], indent=1))
                write_atomically(own / "model.json", json.dumps(row["model"]))
    if options.json:
        print(json.dumps([{k: v for k, v in row.items() if k not in ("fit", "model")} for row in fleet.rows]))
    else:
        print(fleet)
        print(f"  {fleet.outcome}")
        if folder:
            print(f"\nresults in {folder} (fleet.csv, fleet.nc, a folder for each actuator)")
    return 0 if fleet.count("fitted") == len(fleet.rows) else 4
