"""`python -m gmijax.train`: trains a policy in one or several GMIs."""

from __future__ import annotations

import sys

from gmijax.cli import EXIT_OK, command
from gmijax.config import TrainConfig
from gmijax.control import job


def _run(config: TrainConfig) -> int:
    job.train(config, show=True)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(command("train", TrainConfig, _run, sys.argv[1:]))
