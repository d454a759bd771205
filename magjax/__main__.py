"""`python -m magjax` is the command line."""

import sys

from magjax.cli import main

sys.exit(main())
