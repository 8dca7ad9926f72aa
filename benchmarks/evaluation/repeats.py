"""Refuses a marked figure for which a page claims more runs than its file has.

A page claims runs in the line of the figure: `n=3`, "three runs", "ran once"; for a figure in a
table, in a column of runs, else also in the paragraph above the table. A figure without a claim
counts as one of `LEAST` runs, so the page has to write it down if there are fewer.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from benchmarks.evaluation.evidence import LEAST
from benchmarks.evaluation.figures import look_up_all
from benchmarks.evaluation.finding import Finding
from gmijax.errors import ConfigError

NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_RUNS = re.compile(
    rf"\bn ?= ?(\d+)|\b(\d+|{'|'.join(NUMBERS)}) (?:runs?|repeats|trainings?)\b"
    r"(?! (?:at|in|per)\b)|\b(once)\b",
    re.IGNORECASE,
)
_COLUMN = re.compile(r"\bruns\b")


def overstated_runs(name: str, text: str, marked: re.Pattern[str]) -> Iterator[Finding]:
    """Marked figures of a document that have fewer runs than it claims."""
    for match in marked.finditer(text):
        try:
            runs = min(map(len, look_up_all(match[2])[1]))
        except ConfigError:
            continue  # Another check reports it.
        at = text.count("\n", 0, match.start())
        claimed = min(_claimed_runs(text.split("\n"), at, marked), default=LEAST)
        if claimed > runs:
            have = f"{match[2].partition('.json')[0]}.json has {runs} of it"
            yield Finding(name, at + 1, match[4], f"stands for {claimed} runs, and {have}")


def _claimed_runs(lines: list[str], at: int, marked: re.Pattern[str]) -> Iterator[int]:
    """Numbers of runs that a document claims beside a figure in one of its lines."""
    line, above = lines[at], lines[:at]
    if line.startswith("|"):
        table = [at for at, one in enumerate(above) if not one.startswith("|")]
        begin = table[-1] + 1 if table else 0
        for head, cell in zip(_cells(above[begin]), _cells(line), strict=False):
            if _COLUMN.search(head) and cell.isdigit():
                yield int(cell)
                return
        line += " " + " ".join(one for one in above[max(0, begin - 2) : begin] if one)
    for found in _RUNS.finditer(marked.sub("", line)):
        yield _number(next(filter(None, found.groups())).lower())


def _number(word: str) -> int:
    if word == "once":
        return 1
    return int(word) if word.isdigit() else NUMBERS.index(word) + 1


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]
