"""Keeps the figures in documents equal to the files of results: `python -m benchmarks --help`."""

from __future__ import annotations

import argparse
import sys

from benchmarks.evaluation import check, plots
from gmijax.errors import ConfigError
from gmijax.runs.folder import write_text


def main() -> int:
    """Checks or writes; returns 1 if a figure has no file or differs from it, 2 on bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("check", help="compare README.md and docs/ with benchmarks/results")
    commands.add_parser("evaluation", help="write the tables, pictures and marked figures")
    if parser.parse_args().command == "evaluation":
        try:
            write()
        except ConfigError as error:
            sys.stderr.write(f"{error}\n")
            return 2
        return 0
    found = check.check()
    sys.stdout.writelines(f"{finding}\n" for finding in (*found, check.count()))
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
