"""`python -m gmijax.play`: evaluates a checkpoint, and films it."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import PlayConfig
from gmijax.deploy import playing


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return command("play", PlayConfig, playing.play, argv, must_print=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
