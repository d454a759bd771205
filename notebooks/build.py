"""`python notebooks/build.py`: every percent-format source to an .ipynb beside it, run unless --no-run is given."""

import sys
from pathlib import Path

import jupytext

HERE = Path(__file__).parent


def main():
    """Convert all; `--no-run` leaves the outputs out."""
    for source in sorted(HERE.glob("0*.py")):
        notebook = jupytext.read(source)
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        if "--no-run" not in sys.argv:
            from nbclient import NotebookClient

            NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(HERE)}}).execute()
        jupytext.write(notebook, source.with_suffix(".ipynb"))
        print(source.with_suffix(".ipynb").name)


if __name__ == "__main__":
    main()
