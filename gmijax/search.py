"""`python -m gmijax.search`: finds environments per GMI and GMIs per GPU by profiling."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gmijax.cli.command import command
from gmijax.cli.compose import build
from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.control import searching
from gmijax.control.console import Show


def main(argv: list[str]) -> int:
    """Returns the exit code."""

    def make(overrides: Sequence[str]) -> tuple[TrainConfig, Sequence[str]]:
        return build("search", TrainConfig, overrides), overrides

    def run(made: tuple[TrainConfig, Sequence[str]], *, show: Show) -> None:
        config, overrides = made
        searching.search(config, show=show, overrides=overrides)

    return command(
        "search", TrainConfig, run, argv, make=make, shown=lambda made: to_dict(made[0])
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
