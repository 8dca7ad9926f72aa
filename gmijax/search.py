"""`python -m gmijax.search`: finds environments per GMI and GMIs per GPU by profiling."""

from __future__ import annotations

import sys

from gmijax.cli import EXIT_OK, command
from gmijax.config import TrainConfig
from gmijax.control import searching


def _run(config: TrainConfig) -> int:
    searching.search(config, show=True)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(command("search", TrainConfig, _run, sys.argv[1:]))
