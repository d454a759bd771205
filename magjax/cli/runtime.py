"""What commands share: JAX set up once, common options, progress, output folders that are checked before the work."""

import argparse
import gc
import os
import sys
from pathlib import Path

from magjax.errors import ConfigurationError

from .waiting import tell


def prepare_jax(many: bool = False) -> None:
    """Double precision and a compilation cache that outlives the run; on the processor, unless `JAX_PLATFORMS` says otherwise.

    `many`: thousands of trajectories side by side, which go to a GPU where there is one. A fit is a chain of short steps: there it
    takes as long, and its programs twice as long to compile (docs/scale.md).
    """
    gc.set_threshold(50_000, 20, 20)  # traced programs are millions of objects that stay: to look through them takes a second
    import jax

    jax.config.update("jax_enable_x64", True)
    if not many and not jax.config.jax_platforms:
        jax.config.update("jax_platforms", "cpu")
    cache = Path(os.environ.get("MAGJAX_CACHE", Path.home() / ".cache" / "magjax"))
    try:
        cache.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    except OSError:
        pass  # without a cache every run compiles anew; nothing else is lost


class Parser(argparse.ArgumentParser):
    """Wrong use is one line and exit status 2."""

    def error(self, message):
        """One line that names the command and the mend."""
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def positive(text: str) -> int:
    """A whole number above zero, for an option's `type`."""
    if int(text) < 1:
        raise ValueError
    return int(text)


def minutes(text: str) -> float:
    """A time above zero, inf for no limit, for an option's `type`."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is no time above zero; give minutes, say 10, or inf for no limit")
    return value


def seed(text: str) -> int:
    """A whole number of zero or more, for an option's `type`."""
    if int(text) < 0:
        raise ValueError
    return int(text)


def parser(command: str, text: str, example: str) -> Parser:
    """A parser with the common options."""
    made = Parser(
        prog=f"magjax {command}",
        description=text,
        epilog=f"example: {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--json", action="store_true", help="print the result as JSON on stdout; progress goes to stderr")
    made.add_argument("--quiet", action="store_true", help="no progress")
    made.add_argument("--seed", type=seed, default=0, help="seed of everything random (default 0)")
    return made


_made: list[Path] = []  # folders of this run


def discard_empty() -> None:
    """Take away the folders that this run made and left empty: it was refused, or interrupted before anything was reached."""
    for folder in _made:
        try:
            folder.rmdir()
        except OSError:
            pass  # holds something, or is gone
    _made.clear()


def output_folder(path) -> Path | None:
    """A folder that can be written, made before the work starts."""
    if path is None:
        return None
    folder = Path(path)
    if not folder.exists():
        _made.append(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".magjax-write-test"
        probe.write_text("")
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"{folder}: cannot be written ({error.strerror}); choose another --out") from None
    return folder


def as_json(content) -> str:
    """JSON that any parser takes."""
    from ..writers import as_json as written

    return written(content)


def refuse_overwriting(out, *inputs) -> None:
    """Raise `ConfigurationError` where `out` is one of the files that are read."""
    for file in filter(None, inputs):
        if Path(out).exists() and Path(file).exists() and Path(out).samefile(file):
            raise ConfigurationError(f"--out {out}: is the file that is read; give another name")


def told(bench):
    """The bench; what its file does not state, and what stands in for it, is told on stderr."""
    if bench.assumed:
        known = bench.actuator().parameters()
        rows = [f"{n} ({float(known[n][0]):g}{'' if known[n][1].unit == '1' else ' ' + known[n][1].unit})" for n in bench.assumed]
        print(f"bench {bench.source}: does not state {', '.join(rows)}; taken from T&B's bench: write yours", file=sys.stderr)
    return bench


class Progress:
    """What a long step reports, called as progress(text, step, chi2 per datum): the words of the command's spinner."""

    def __init__(self, quiet: bool):
        self.quiet = quiet

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def __call__(self, text, step=0, chi2=None):
        """What is being done, at which step, with which misfit."""
        if not self.quiet:
            misfit = "" if chi2 is None else f", chi2/N = {chi2:.4g}"
            tell(f"{text}{f': step {step}' if step else ''}{misfit}")
