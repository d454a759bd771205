"""The command line: `magjax COMMAND --help`. Each command imports its part only when it runs."""

import importlib
import os
import sys

COMMANDS = {
    "demo": ("magjax.cli.fit", "invent a concealed bench, record it, fit it, diagnose it"),
    "fit": ("magjax.cli.fit", "joint fit of recordings"),
    "diagnose": ("magjax.cli.fit", "missing physics: where, what, and the repaired model"),
    "simulate": ("magjax.cli.simulate", "the actuator under a drive"),
    "sweep": ("magjax.cli.simulate", "a grid of frequencies and amplitudes to NetCDF"),
    "check": ("magjax.cli.data", "is a recording fit to use"),
    "import": ("magjax.cli.data", "other formats into NetCDF"),
    "export": ("magjax.cli.data", "recordings into CSV, MAT or NetCDF"),
    "report": ("magjax.cli.fit", "build the HTML report of a result folder again"),
    "invert": ("magjax.cli.control", "a wanted displacement to the current to apply"),
    "control": ("magjax.cli.control", "l1 design, margins, closed-loop simulation"),
    "ports": ("magjax.cli.acquire", "serial ports of this machine"),
    "emulate": ("magjax.cli.acquire", "a bench as a device behind a pseudo-terminal or TCP port"),
    "record": ("magjax.cli.acquire", "a crash-safe recording from a device, or a whole plan"),
    "investigate": ("magjax.cli.investigate", "record, fit, diagnose, record what is asked for, until it is settled"),
}


def usage() -> str:
    """The text of `magjax --help`."""
    rows = "\n".join(f"  {name:11s} {text}" for name, (_, text) in COMMANDS.items())
    return (
        "Usage: magjax COMMAND [OPTIONS]\n\nSimulate, fit and diagnose hysteretic magnetostrictive actuators.\n\n"
        f"Commands (magjax COMMAND --help explains each):\n{rows}\n\n"
        "Start with: magjax demo\n"
        "Exit status: 0 done; 2 wrong use; 3 recording unusable; 4 done but not to be trusted;\n  5 device or port; 6 recording ended early but intact; 130 interrupted."
    )


def main(arguments=None) -> int:
    """Run one command; every failure is one line on stderr and an exit status."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    if arguments[0] == "--version":
        from magjax import __version__

        print(__version__)
        return 0
    if arguments[0] not in COMMANDS:
        import difflib

        close = difflib.get_close_matches(arguments[0], COMMANDS, 1)
        hint = f'; did you mean "{close[0]}"?' if close else f"; commands are {', '.join(COMMANDS)}"
        print(f'magjax: no command "{arguments[0]}"{hint}', file=sys.stderr)
        return 2
    from magjax.errors import MagjaxError
    from magjax.interrupts import seen, watched

    from .waiting import Waiting

    calm = not {"-h", "--help", "--quiet"}.isdisjoint(arguments)
    try:
        with watched(), Waiting(f"magjax {arguments[0]}", active=not calm):
            module = importlib.import_module(COMMANDS[arguments[0]][0])
            return module.run(arguments[0], arguments[1:]) or 0
    except MagjaxError as error:
        print(f"magjax {arguments[0]}: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print(f"magjax {arguments[0]}: interrupted; what was reached is kept", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 0
    except OSError as error:
        if error.errno is None:
            raise
        where = f"{error.filename}: " if error.filename else ""
        print(f"magjax {arguments[0]}: {where}cannot be read or written ({error.strerror}); choose another place", file=sys.stderr)
        return 2
    except Exception:
        if not seen():
            raise
        print(f"magjax {arguments[0]}: interrupted", file=sys.stderr)  # inside an import that made another error of it
        return 130
    finally:
        if used := sys.modules.get("magjax.cli.runtime"):
            used.discard_empty()


if __name__ == "__main__":
    sys.exit(main())
