"""`python notebooks/build.py [01 07 ...]`: percent-format sources to an .ipynb beside each, run unless --no-run is given."""

import os
import sys
import tempfile
from pathlib import Path

import jupytext

HERE = Path(__file__).parent


def run(notebook):
    """Fill in the outputs, in a folder of its own: what a notebook writes does not stay among the sources."""
    from nbclient import NotebookClient

    os.environ.pop("MPLBACKEND", None)  # the kernel's own puts pictures into the outputs
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": folder}}).execute()


def main():
    """Convert all, or those whose numbers are given; `--no-run` leaves the outputs out."""
    wanted = tuple(a for a in sys.argv[1:] if not a.startswith("--")) or ("0",)
    for source in sorted(p for p in HERE.glob("0*.py") if p.name.startswith(wanted)):
        notebook = jupytext.read(source)
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        if "--no-run" not in sys.argv:
            run(notebook)
        jupytext.write(notebook, source.with_suffix(".ipynb"))
        print(source.with_suffix(".ipynb").name)


if __name__ == "__main__":
    main()
