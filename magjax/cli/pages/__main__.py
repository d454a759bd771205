"""`python -m magjax.cli.pages [--check]`: every generated page at once, docs/effects.md too."""

import sys

from magjax.effects import page as effects

from . import commands, parameters, results


def main(arguments=None) -> int:
    """Write (or check) all pages; 1 where one is not up to date."""
    return max(module.main(arguments) for module in (effects, parameters, commands, results))


if __name__ == "__main__":
    sys.exit(main())
