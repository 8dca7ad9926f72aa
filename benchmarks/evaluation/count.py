"""Counts the figures of documents, and those of them that are well supported.

A figure is a marked one, or a cell with a digit in a column of numbers that are measured. It is
supported if its file has commit and date, and at least three runs are behind it. A cell may state
their number (`n=3`, `5 of 20`); without one it has as many as every case of its files, at least
one; a ratio has as many as the cells of its row. Files are those below a table, or the one that a
row names. Not counted: tables of words, which repeat figures of others.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from benchmarks.evaluation.evidence import LEAST
from benchmarks.evaluation.figures import look_up_all
from gmijax.errors import ConfigError

SETTINGS = frozenset(
    (
        *("environments", "GPUs", "steps", "million steps", "call", "cap, %", "SMs", "kinds"),
        *(
            "sweeps",
            "seeds",
            "profiles",
            "return",
            "mark",
            "MIG",
            "Isaac Gym, on an A100",
            "model",
        ),
        *("at the end: million steps", "faults"),
    )
)
"""Columns of numbers that were chosen or counted."""

_RATIO = re.compile(r"over |ratio|of ideal|measured$|two GMIs")
_OF = re.compile(r"n=(\d+)|\d+ of (\d+)")
_REPEATS = re.compile(r"(\d+)(?: to \d+)? runs? of each case")


class Count(NamedTuple):
    """A number of figures.

    Attributes:
      all: figures.
      supported: those with commit, date and enough runs.
    """

    all: int = 0
    supported: int = 0

    def __add__(self, other: tuple[int, ...]) -> Count:
        return Count(self.all + other[0], self.supported + other[1])

    def __str__(self) -> str:
        return f"figures: {self.all}, with commit, date and n>={LEAST}: {self.supported}"


def of_figure(reference: str) -> Count:
    """The count of one marked figure; it is not supported if its file is gone."""
    try:
        call, values = look_up_all(reference)
    except ConfigError:
        return Count(1)
    has_origin = call.commit and call.date
    return Count(1, int(bool(has_origin and min(map(len, values)) >= LEAST)))


def of_table(text: str) -> Count:
    """The count of a table as a document has it: one head or several, files below each."""
    total = Count()
    lines = text.splitlines()
    rules = [at for at, line in enumerate(lines) if re.match(r"\| ---", line)]
    for at, end in zip(rules, [*(at - 1 for at in rules[1:]), len(lines)], strict=False):
        head, rule = _cells(lines[at - 1]), _cells(lines[at])
        measured = [r == "---:" and not _is_setting(h) for h, r in zip(head, rule, strict=True)]
        sources = [line for line in lines[at:end] if line.startswith("- [`")]
        for line in lines[at + 1 : end]:
            if line.startswith("|"):
                total += _of_row(head, measured, _cells(line), sources)
    return total


def _is_setting(name: str) -> bool:
    return name in SETTINGS or name.startswith("the paper's")


def _of_row(
    head: Sequence[str], measured: Sequence[bool], cells: Sequence[str], sources: Sequence[str]
) -> Count:
    mine = [one for one in sources if any(_names(one, cell) for cell in cells)] or sources
    has_origin = bool(mine) and not any("unknown" in one for one in mine)
    at_least = min((_least(_REPEATS, one) for one in mine), default=1)
    own = max((_least(_OF, cell) for cell in cells if " of " in cell), default=0) or at_least
    figures = [
        (bool(_RATIO.match(name)), max(own, _least(_OF, cell)) if "n=" in cell else own, cell)
        for name, is_measured, cell in zip(head, measured, cells, strict=True)
        if is_measured and re.search(r"\d", cell)
    ]
    of_row = min((n for is_ratio, n, _ in figures if not is_ratio), default=at_least)
    runs = [of_row if is_ratio and "n=" not in cell else n for is_ratio, n, cell in figures]
    return Count(len(figures), sum(has_origin and n >= LEAST for n in runs))


def _names(source: str, cell: str) -> bool:
    return bool(re.fullmatch(r"`[\w.-]+`", cell)) and f"[`{cell[1:-1]}.json`]" in source


def _least(pattern: re.Pattern[str], text: str) -> int:
    """The smallest number that a pattern finds, 1 without any."""
    return min(_numbers(pattern, text), default=1)


def _numbers(pattern: re.Pattern[str], text: str) -> Iterator[int]:
    for match in pattern.finditer(text):
        yield int(next(filter(None, match.groups())))


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]
