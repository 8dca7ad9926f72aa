"""`python -m gmijax.sweep`: many runs, several at a time on every GPU."""

from __future__ import annotations

import sys

from gmijax.cli.command import sweep_command


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return sweep_command(argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
