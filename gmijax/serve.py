"""`python -m gmijax.serve`: collects experience with a trained policy or random actions."""

from __future__ import annotations

import sys

from gmijax.cli import EXIT_OK, command
from gmijax.config import ServeConfig
from gmijax.control import serving


def _run(config: ServeConfig) -> int:
    serving.serve(config, show=True)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(command("serve", ServeConfig, _run, sys.argv[1:]))
