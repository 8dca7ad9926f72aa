"""`python -m gmijax.view`: a policy in the browser, live, also that of a running training."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import ViewConfig
from gmijax.deploy import viewing


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return command("view", ViewConfig, viewing.view, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
