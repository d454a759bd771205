"""What the generated pages of docs/ share: Markdown tables, writing a page, checking that the written one is up to date."""

import argparse
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def cell(text) -> str:
    """A text that does not break a Markdown table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def table(head, rows) -> list[str]:
    """Lines of a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(cell(v) for v in row) + " |" for row in rows]


def number(value) -> str:
    """A number as a page shows it; empty for None and for infinity."""
    return "" if value is None or abs(value) == float("inf") else f"{value:g}"


def extent(pair) -> str:
    """A range as "low .. high", open ends left empty; empty where both are."""
    low, high = (number(v) for v in (pair or (None, None)))
    return f"{low} .. {high}".strip() if low or high else ""


def deliver(name: str, text: str, module: str, arguments=None) -> int:
    """Write docs/`name`; with --check only compare: 0 where it is up to date, 1 and one line where not.

    A file named in the arguments takes the place of the page in docs/.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=f"Writes docs/{name} from the code.")
    parser.add_argument("target", type=Path, nargs="?", default=DOCS / name, help="another file in its place")
    parser.add_argument("--check", action="store_true", help="only say whether the file is up to date")
    given = parser.parse_args(arguments)
    target = given.target
    if not given.check:
        target.write_text(text, encoding="utf-8")
        print(target)
        return 0
    if target.exists() and target.read_text(encoding="utf-8") == text:
        return 0
    print(f"{target}: not what the code says now; type python -m {module}", file=sys.stderr)
    return 1
