"""`python -m gmijax.search`: finds environments per GMI and GMIs per GPU by profiling."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import TrainConfig
from gmijax.control import searching


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return command("search", TrainConfig, searching.search, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
