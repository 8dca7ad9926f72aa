"""`python -m gmijax.pack`: any training command, several at a time on every GPU."""

from __future__ import annotations

import sys

from gmijax.cli.pack import pack_command


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return pack_command(argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
