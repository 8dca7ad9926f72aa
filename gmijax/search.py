"""`python -m gmijax.search`: finds environments per GMI and GMIs per GPU by profiling."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import TrainConfig
from gmijax.control import searching

if __name__ == "__main__":
    sys.exit(command("search", TrainConfig, searching.search, sys.argv[1:]))
