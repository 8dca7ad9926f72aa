"""Refuses files without a commit, and figures of few runs that `benchmarks/plan.md` does not name.

The front page may have no figure of few runs. The plan has a table of the files with one or
two runs of the figures in a row.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from benchmarks.evaluation.evidence import LEAST, Evidence
from benchmarks.evaluation.finding import Finding
from benchmarks.evaluation.page import WORD_TABLES
from benchmarks.records import RESULTS, read_calls

PLAN = Path(__file__).parents[1] / "plan.md"
SELDOM = f"| files with fewer than {LEAST} runs |"
"""Head of the plan's table of files."""
STRICT = "front"
"""The table of the front page."""

WordTables = Mapping[str, Callable[[], list[tuple[str, Evidence | None]]]]
"""Name of a table of words -> its lines, each with the evidence of its figures."""


def without_commit(results: Path = RESULTS) -> Iterator[Finding]:
    """Files with a call of which the commit is not known."""
    for path in sorted(results.glob("*.json")):
        if not all(call.commit for call in read_calls(path)):
            yield Finding(path.name, 1, path.stem, "has a call without a commit")


def unplanned(tables: WordTables = WORD_TABLES, plan: Path = PLAN) -> Iterator[Finding]:
    """Rows of few runs that the plan does not name, and files that it names without need."""
    seldom = _planned(plan.read_text())
    needed: set[str] = set()
    for table, rows in tables.items():
        for number, (line, evidence) in enumerate(rows(), 1):
            if evidence is None or evidence.is_enough:
                continue
            files = {one.file for one in evidence.sources}
            needed |= files
            if table == STRICT:
                wanted = f"the front page wants commit and {LEAST} runs, and this is {evidence}"
                yield Finding(f"table {table}", number, line, wanted)
            elif missing := sorted(files - seldom.keys()):
                lacks = f"is {evidence}, and {plan.name} has no row of {', '.join(missing)}"
                yield Finding(f"table {table}", number, line, lacks)
    for name, at in seldom.items():
        if name not in needed:
            yield Finding(plan.name, at, name, "no row says figures of so few runs: it is done")


def _planned(text: str) -> dict[str, int]:
    """Names of files in the first column of the table, and the numbers of their lines."""
    if (found := re.search(f"^{re.escape(SELDOM)}", text, re.MULTILINE)) is None:
        return {}
    begin, end = found.start(), text.find("\n## ", found.start())
    rows = re.finditer(r"^\|([^|]*)\|", text[begin : None if end < 0 else end], re.MULTILINE)
    return {
        name[1]: text.count("\n", 0, begin + row.start() + name.start()) + 1
        for row in rows
        for name in re.finditer(r"`([^`]+)`", row[1])
    }
