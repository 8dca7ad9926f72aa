"""`python -m gmijax.play`: evaluates a checkpoint, and films it."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import PlayConfig
from gmijax.control import evaluation

if __name__ == "__main__":
    sys.exit(command("play", PlayConfig, evaluation.play, sys.argv[1:]))
