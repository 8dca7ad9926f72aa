"""Keeps the figures in documents equal to the files of results: `python -m benchmarks --help`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.evaluation import check, plots
from benchmarks.records import add_calls
from gmijax.errors import ConfigError
from gmijax.runs.folder import write_text


def main() -> int:
    """Runs one command; returns 1 if a figure is not that of its file, 2 on bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("check", help="compare README.md and docs/ with benchmarks/results")
    commands.add_parser("evaluation", help="write the tables, pictures and marked figures")
    add = commands.add_parser("add", help="add the calls of another machine to benchmarks/results")
    add.add_argument("files", nargs="+", type=Path, metavar="FILE")
    given = parser.parse_args()
    try:
        if given.command == "add":
            add_calls(given.files)
        elif given.command == "evaluation":
            write()
        else:
            return _checked()
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _checked() -> int:
    found = check.check()
    excused = f"lines that are excused by '{check.NO_FIGURE}': {check.excused()}"
    sys.stdout.writelines(f"{one}\n" for one in (*found, check.count(), excused))
    return int(bool(found))


def write() -> None:
    """Writes the pictures, and the tables and marked figures of all documents."""
    plots.draw()
    for path in check.documents():
        text = path.read_text()
        if (filled := check.fill(text)) != text:
            write_text(path, filled)
            sys.stdout.write(f"written: {path}\n")


if __name__ == "__main__":
    sys.exit(main())
