"""`python -m tests.ends [oldest|newest|both]`: fresh environments with the oldest and the newest versions that pyproject.toml admits.

Each is installed beside the checkout's own environment (needs uv and an interpreter of that version on the machine), then the smoke
tests run in it. What cannot be installed is skipped with a reason; exit status 1 where a test fails.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SMOKE = (
    "tests/test_structure.py", "tests/data/test_formats.py", "tests/test_adding_an_effect.py",
    "tests/test_fit.py::test_bounded_minimum_meets_the_optimality_conditions", "tests/test_fit.py::test_reaches_the_noise_and_the_constants",
)  # fmt: skip
NEWEST = ("3.14", "3.13", "3.12")


def oldest_python() -> str:
    """The lowest Python that pyproject.toml admits."""
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    return stated.removeprefix(">=")


def interpreter(version: str) -> str | None:
    """An interpreter of that version on this machine: on the path or among pyenv's; None where there is none."""
    places = [shutil.which(f"python{version}"), *sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    for place in filter(None, places):
        asked = subprocess.run(
            [str(place), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], capture_output=True, text=True
        )
        if asked.stdout.strip() == version:
            return str(place)
    return None


def environment(where: Path, version: str, resolution: str) -> str | None:
    """Make an environment; None where it was made, else why it could not be."""
    quiet = {"capture_output": True, "text": True, "env": {**os.environ, "UV_PYTHON_DOWNLOADS": "never", "VIRTUAL_ENV": str(where)}}
    uv = shutil.which("uv")
    if uv is None:
        return "uv is not installed"
    python = interpreter(version)
    if python is None:
        return f"no Python {version} on this machine"
    made = subprocess.run([uv, "venv", "-q", "--python", python, str(where)], **quiet)
    if made.returncode:
        return f"uv venv: {made.stderr.strip().splitlines()[-1]}"
    done = subprocess.run([uv, "pip", "install", "-q", "--resolution", resolution, "-e", f"{ROOT}[test]"], **quiet)
    return (
        None
        if done.returncode == 0
        else f"cannot be installed: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'uv failed'}"
    )


def versions(where: Path) -> str:
    """What was installed, in a line."""
    code = (
        "import sys; from importlib.metadata import version as v\n"
        "print('Python', sys.version.split()[0], *(f'{p} {v(p)}' for p in ('jax', 'equinox', 'optimistix', 'numpy', 'scipy', 'control')))"
    )
    return subprocess.run([str(where / "bin" / "python"), "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def smoke(where: Path, tests) -> int:
    """Run tests in an environment; pytest's exit status."""
    settings = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "MAGJAX_CACHE": str(where / "cache")}
    return subprocess.run(
        [str(where / "bin" / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], cwd=ROOT, env=settings
    ).returncode


def attempt(name: str, place: Path, tests) -> int:
    """One end: 0 passed or skipped with a reason, 1 failed."""
    begin, reason = time.monotonic(), "no such Python"
    wanted = ((oldest_python(), "lowest-direct"),) if name == "oldest" else tuple((v, "highest") for v in NEWEST)
    for version, resolution in wanted:
        where = place / f"{name}-{version}"
        reason = environment(where, version, resolution)
        if reason is None:
            print(f"{name}: {versions(where)}", flush=True)
            status = smoke(where, tests)
            print(f"{name}: {'passed' if status == 0 else 'FAILED'} in {time.monotonic() - begin:.0f} s", flush=True)
            return int(status != 0)
    print(f"{name}: skipped, {reason}", flush=True)
    return 0


def main(arguments) -> int:
    """Try the ends that are named (both by default); further arguments are the tests to run instead of the smoke tests."""
    names = {"oldest": ("oldest",), "newest": ("newest",)}.get(arguments[0] if arguments else "both", ("oldest", "newest"))
    with tempfile.TemporaryDirectory() as folder:
        return max(attempt(name, Path(folder), arguments[1:] or SMOKE) for name in names)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
