"""`python -m gmijax.train`: trains a policy in one or several GMIs; with `-m` many of them."""

from __future__ import annotations

import sys

from gmijax.cli.command import command, sweep_command
from gmijax.config import TrainConfig
from gmijax.control import job


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    rest = [text for text in argv if text not in ("-m", "--multirun")]
    if len(rest) < len(argv):
        return sweep_command(rest)
    return command("train", TrainConfig, job.train, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
