"""Compares the figures in README.md and docs/ with the files of results.

A figure in a text stands in a marker, `<!-- figure: FILE.json#PATH FORMAT -->1.42<!-- /figure -->`
(`figures.look_up` describes the path; the format is Python's), and a table between
`<!-- table: NAME -->` and `<!-- /table -->`. `fill` writes what belongs there. What looks like a
measurement elsewhere is a finding, but for code and lines that end with `<!-- no figure -->`:
limits, examples, and what others report; `excused` counts them. Figures of a decision are of its
day: one with the words "as measured then" may have some without a file. A document has to state
how many runs a figure has if they are few (`repeats`), and `benchmarks/plan.md` has to name every
figure of few runs or without a commit (`planned`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from pathlib import Path

from benchmarks.evaluation.count import Count, of_figure, of_table
from benchmarks.evaluation.figures import look_up
from benchmarks.evaluation.finding import Finding
from benchmarks.evaluation.page import TABLES
from benchmarks.evaluation.planned import unplanned, without_commit
from benchmarks.evaluation.plots import FOLDER, PICTURES, is_current
from benchmarks.evaluation.repeats import overstated_runs
from gmijax.errors import ConfigError

ROOT = Path(__file__).parents[2]
FIGURE = re.compile(r"(<!-- figure: ([^>]+?) (\S+) -->)(.*?)(<!-- /figure -->)")
TABLE = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- /table -->)", re.DOTALL)
NO_FIGURE = "<!-- no figure -->"
OF_ITS_DAY = "as measured then"
MEASUREMENTS = tuple(
    re.compile(pattern)
    for pattern in (
        r"\d[\d,.]*\s*[kM]?\s*(?:env(?:ironment)? )?steps(?:/s| per second| a second)",
        r"\b\d{1,3}(?:,\d{3}){2,}\b|\b\d{3},\d{3}\b",
        r"\b\d+\.\d+x? times\b|\b\d+(?:\.\d+)? times (?:as fast|faster|slower|the steps)\b",
        r"\b\d+\.\d+x\b",
        r"\b[\d.]+ ?% (?:of (?:a|the|one) (?:GPU|SMs|rate|time)|faster|slower|fewer)\b",
        r"\b(?:after|took|takes|in) [\d.]+ (?:s|ms|us|min|minutes|seconds|hours)\b",
        r"\b[\d.]+ (?:GB/s|TFLOP/s|runs/h)",
        r"\breturns? of \d[\d,.]*\b(?! episodes)",
    )
)
"""What looks like a measurement: rates, large counts, ratios, parts, seconds to a mark."""


def documents(root: Path = ROOT) -> list[Path]:
    """All documents that are checked."""
    found = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    return [path for path in found if path.exists()]


def fill(text: str) -> str:
    """A document with every marked figure and table filled in from the files.

    Raises:
      ConfigError: a figure without a file, or a table that is none of ours.
    """
    text = FIGURE.sub(lambda m: m[1] + _figure(m[2], m[3]) + m[5], text)
    return TABLE.sub(lambda m: m[1] + _table(m[2]) + m[4], text)


def check(root: Path = ROOT) -> list[Finding]:
    """All findings; none means that every figure agrees with its file."""
    found = [finding for path in documents(root) for finding in in_document(path, root)]
    for name in PICTURES:
        if not is_current(name):
            path = (FOLDER / f"{name}.svg").relative_to(ROOT).as_posix()
            found.append(Finding(path, 1, name, "its numbers are not those of the files"))
    return [*found, *without_commit(), *unplanned()]


def count(root: Path = ROOT) -> Count:
    """The figures of all documents but decisions, whose figures are of their day."""
    total = Count()
    for path in documents(root):
        if path.parent.name != "decisions":
            text = path.read_text()
            for match in FIGURE.finditer(text):
                total += of_figure(match[2])
            for match in TABLE.finditer(text):
                total += of_table(match[3])
    return total


def excused(root: Path = ROOT) -> int:
    """Number of lines marked as not being a measurement of this project."""
    return sum(path.read_text().count(NO_FIGURE) for path in documents(root))


def in_document(path: Path, root: Path = ROOT) -> Iterator[Finding]:
    """Findings in one document."""
    text, name = path.read_text(), path.relative_to(root).as_posix()
    for match in (*FIGURE.finditer(text), *TABLE.finditer(text)):
        yield from _compared(name, text, match)
    if path.parent.name != "decisions":
        yield from overstated_runs(name, text, FIGURE)
    if path.parent.name != "decisions" or OF_ITS_DAY not in text:
        yield from _unmarked(name, text)


def _compared(name: str, text: str, match: re.Match[str]) -> Iterator[Finding]:
    """Findings where a marked figure or table differs from its files."""
    line = text.count("\n", 0, match.start()) + 1
    written = match[len(match.groups()) - 1]
    try:
        wanted = _figure(match[2], match[3]) if match.re is FIGURE else _table(match[2])
    except (ConfigError, ValueError) as error:
        yield Finding(name, line, written, str(error))
        return
    if match.re is TABLE:
        yield from _differences(name, written, wanted, line + 1)
    elif written != wanted:
        yield Finding(name, line, written, f"{match[2]} is {wanted}")


def _differences(name: str, written: str, wanted: str, first: int = 1) -> Iterator[Finding]:
    old, new = written.splitlines(), wanted.splitlines()
    for tag, a, b, c, d in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if tag != "equal":
            line = first + a
            problem = f"the files say {' / '.join(new[c:d])!r}"
            yield Finding(name, line, " / ".join(old[a:b]), problem)


def _unmarked(name: str, text: str) -> Iterator[Finding]:
    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    for pattern in (TABLE, FIGURE, re.compile(r"```.*?```", re.DOTALL), re.compile(r"`[^`\n]*`")):
        text = pattern.sub(blank, text)
    for number, line in enumerate(text.splitlines(), 1):
        if line.rstrip().endswith(NO_FIGURE):
            continue
        end = 0
        found = (match for pattern in MEASUREMENTS for match in pattern.finditer(line))
        for match in sorted(found, key=re.Match.start):
            if match.start() >= end:  # Else it is a part of the one before.
                yield Finding(name, number, match[0], "looks like a measurement and names no file")
                end = match.end()


def _figure(reference: str, form: str) -> str:
    return format(look_up(reference), form)


def _table(name: str) -> str:
    if name not in TABLES:
        raise ConfigError(f"table {name}: expected one of {', '.join(sorted(TABLES))}")
    return "\n".join(TABLES[name]()) + "\n"
