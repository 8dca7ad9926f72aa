"""`python -m gmijax.sweep`: many trainings, several at a time on every GPU."""

from __future__ import annotations

import sys

from gmijax.cli.command import sweep_command

if __name__ == "__main__":
    sys.exit(sweep_command(sys.argv[1:]))
