"""README's tour as a test reads it: files to save, commands to type, what comes back; `python -m tests.readme` writes the outputs anew.

A comment before a fenced block says what it is: `<!-- test: quick -->` commands of seconds, `long` of minutes, `background` one that runs on
beside the others, `file NAME` a file to save. `lines N`: only the first N lines are compared; `within R`: numbers may differ by this share.
"""

import dataclasses
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
FENCE = re.compile(r"<!-- test: (?P<what>[^>]*?) -->\n```(?P<language>\w+)\n(?P<content>.*?)```", re.S)
TINY = 5e-9  # below it (m, A) a number is noise
FACTORS = {"um": 1e-6, "nm": 1e-9}  # of the word after a number


@dataclasses.dataclass(frozen=True)
class Block:
    """One fenced block: `kind` quick, long, background or file; `target` of a file; what of its output is compared."""

    kind: str
    target: str
    content: str
    lines: int
    within: float

    def steps(self) -> list[tuple[str, str]]:
        """(command, output) of each `$` in order."""
        parts = re.split(r"^\$ ", self.content, flags=re.M)[1:]
        return [tuple(part.split("\n", 1)) for part in parts]


def blocks(text: str) -> list[Block]:
    """The marked blocks of a page."""
    found = []
    for match in FENCE.finditer(text):
        words = {w.split()[0]: w.split()[1:] for w in match["what"].split(",")}
        kind = next(iter(words))
        target = words[kind][0] if words[kind] else ""
        lines, within = int(words.get("lines", ["10000"])[0]), float(words.get("within", ["0.3"])[0])
        found.append(Block(kind, target, match["content"], lines, within))
    return found


def environment() -> dict:
    """What a command of the tour runs under: this checkout, the tests' cache."""
    from tests.conftest import cache

    return {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "MAGJAX_CACHE": str(cache),
        "OPENBLAS_NUM_THREADS": "1",
        "MPLBACKEND": "Agg",
        "COLUMNS": "200",
    }


def run(command: str, folder: Path) -> str:
    """Type a command in a folder; what came back, errors among it. Raises `AssertionError` where it fails."""
    line = f'magjax() {{ {shlex.quote(sys.executable)} -m magjax "$@"; }}; {command}'
    done = subprocess.run(
        ["bash", "-c", line], cwd=folder, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.returncode == 0, f"$ {command}\n{done.stdout[-3000:]}"
    return done.stdout


def start(command: str, folder: Path):
    """Type a command that runs on: (process, its first line)."""
    words = [sys.executable, "-m", *shlex.split(command)]
    process = subprocess.Popen(words, cwd=folder, env=environment(), stdout=subprocess.PIPE, text=True)
    return process, process.stdout.readline()


def end(process) -> None:
    """End what `start` began."""
    process.terminate()
    process.wait(20)
    process.stdout.close()


def words_of(line: str) -> list[str]:
    """The words of a line, a time taken replaced by T."""
    return re.sub(r"\bin \d+(\.\d+)? s\b", "in T s", line).split()


def number(word: str):
    """The number a word is, its punctuation aside; None where it is none."""
    try:
        return float(word.strip("(),;:%"))
    except ValueError:
        return None


def differs(expected: str, got: str, block: Block) -> str | None:
    """What does not fit between two outputs, in a sentence; None where they have the same shape and close numbers."""
    wanted, came = ([line for line in text.splitlines() if line.strip()][: block.lines] for text in (expected, got))
    if len(wanted) != len(came):
        return f"{len(wanted)} lines were stated, {len(came)} came:\n{got}"
    for a, b in zip(wanted, came, strict=True):
        first, second = words_of(a), words_of(b)
        if len(first) != len(second):
            return f"stated: {a}\ncame:   {b}"
        for x, y, after in zip(first, second, [*first[1:], ""], strict=True):
            p, q, tiny = number(x), number(y), TINY / FACTORS.get(after.strip(".,;()"), 1.0)
            close = p is not None and q is not None and abs(p - q) <= max(block.within * max(abs(p), abs(q)), tiny)
            if x != y and not close:
                return f'"{x}" was stated, "{y}" came, in\nstated: {a}\ncame:   {b}'
    return None


def rewrite(folder: Path, kinds=("quick", "background", "file")) -> str:
    """README with the outputs that come now, for blocks of these kinds."""
    running = []

    def again(match):
        block = blocks(match.group(0))[0]
        if block.kind == "file":
            (folder / block.target).write_text(block.content)
        if block.kind == "file" or block.kind not in kinds:
            return match.group(0)
        made = ""
        for command, _ in block.steps():
            if block.kind == "background":
                process, output = start(command, folder)
                running.append(process)
            else:
                output = run(command, folder)
            made += f"$ {command}\n{output.rstrip()}\n"
        return match.group(0).replace(block.content, made)

    try:
        return FENCE.sub(again, README.read_text(encoding="utf-8"))
    finally:
        for process in running:
            end(process)


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as place:
        new = rewrite(Path(place), ("quick", "background", "file", *sys.argv[1:]))
    README.write_text(new, encoding="utf-8")
