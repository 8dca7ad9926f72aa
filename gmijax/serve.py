"""`python -m gmijax.serve`: collects experience with a trained policy or random actions."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import ServeConfig
from gmijax.control import serving


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return command("serve", ServeConfig, serving.serve, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
