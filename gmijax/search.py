"""`python -m gmijax.search`: finds environments per GMI and GMIs per GPU by profiling."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gmijax.cli.command import command
from gmijax.cli.compose import build
from gmijax.config import TrainConfig
from gmijax.control import searching
from gmijax.control.console import Show


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    given: list[str] = []

    def make(overrides: Sequence[str]) -> TrainConfig:
        given.extend(overrides)
        return build("search", TrainConfig, overrides)

    def run(config: TrainConfig, *, show: Show) -> None:
        searching.search(config, show=show, overrides=given)

    return command("search", TrainConfig, run, argv, make=make, must_print=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
