"""`python -m gmijax.train`: trains a policy in one or several GMIs."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import TrainConfig
from gmijax.control import job

if __name__ == "__main__":
    sys.exit(command("train", TrainConfig, job.train, sys.argv[1:]))
