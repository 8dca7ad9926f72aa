"""`python -m gmijax.export`: writes the policy of a checkpoint as files that need no gmijax."""

from __future__ import annotations

import sys

from gmijax.cli.command import command
from gmijax.config import ExportConfig
from gmijax.deploy import exporting


def main(argv: list[str]) -> int:
    """Returns the exit code."""
    return command("export", ExportConfig, exporting.export, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
