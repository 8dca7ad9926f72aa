"""`python -m gmijax.play`: evaluates a checkpoint, and films it."""

from __future__ import annotations

import sys

from gmijax.cli import EXIT_OK, command
from gmijax.config import PlayConfig
from gmijax.control import evaluation


def _run(config: PlayConfig) -> int:
    evaluation.play(config, show=True)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(command("play", PlayConfig, _run, sys.argv[1:]))
