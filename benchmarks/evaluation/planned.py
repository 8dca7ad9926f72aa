"""Refuses what few runs or no commit back, unless `benchmarks/plan.md` names a call to repeat it.

On the front page nothing of that kind may stand. The plan has two tables of files: those without a
commit, and those with a commit that have one or two runs of what a row says.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from benchmarks.evaluation.evidence import LEAST, Evidence
from benchmarks.evaluation.finding import Finding
from benchmarks.evaluation.page import SAID
from benchmarks.records import RESULTS, read_calls

PLAN = Path(__file__).parents[1] / "plan.md"
WITHOUT_COMMIT, SELDOM = "| files |", f"| files with fewer than {LEAST} runs |"
"""Heads of the plan's tables of files."""
STRICT = "front"
"""The table of the front page."""

Words = Mapping[str, Callable[[], list[tuple[str, Evidence | None]]]]
"""Tables of words: their lines, with what their figures are of."""


def without_commit(results: Path = RESULTS, plan: Path = PLAN) -> Iterator[Finding]:
    """Files without a commit that the plan does not name, and the reverse."""
    planned = _planned(plan.read_text(), WITHOUT_COMMIT)
    for path in sorted(results.glob("*.json")):
        has_commit = all(call.commit for call in read_calls(path))
        if (line := planned.pop(path.stem, None)) is None and not has_commit:
            yield Finding(
                path.name, 1, path.stem, f"has no commit, and {plan.name} has no row of it"
            )
        elif line is not None and has_commit:
            yield Finding(plan.name, line, path.stem, "has a commit: its row is done")
    for name, line in planned.items():
        yield Finding(plan.name, line, name, "there is no such file of results")


def unplanned(said: Words = SAID, plan: Path = PLAN) -> Iterator[Finding]:
    """Rows that few runs or no commit back and the plan does not name, and the reverse."""
    text = plan.read_text()
    seldom, old = _planned(text, SELDOM), _planned(text, WITHOUT_COMMIT)
    needed: set[str] = set()
    for table, rows in said.items():
        for number, (line, evidence) in enumerate(rows(), 1):
            if evidence is None or evidence.is_enough:
                continue
            files = {one.file for one in evidence.sources}
            needed |= files
            if table == STRICT:
                wanted = f"the front page wants commit and {LEAST} runs, and this is {evidence}"
                yield Finding(f"table {table}", number, line, wanted)
            elif missing := sorted(files - {*seldom, *old}):
                lacks = f"is {evidence}, and {plan.name} has no row of {', '.join(missing)}"
                yield Finding(f"table {table}", number, line, lacks)
    for name, at in seldom.items():
        if name not in needed:
            yield Finding(plan.name, at, name, "no row says figures of so few runs: it is done")


def _planned(text: str, head: str) -> dict[str, int]:
    """Names of files in the first column of a table, and the lines where they stand."""
    if (found := re.search(f"^{re.escape(head)}", text, re.MULTILINE)) is None:
        return {}
    begin, end = found.start(), text.find("\n## ", found.start())
    rows = re.finditer(r"^\|([^|]*)\|", text[begin : None if end < 0 else end], re.MULTILINE)
    return {
        name[1]: text.count("\n", 0, begin + row.start() + name.start()) + 1
        for row in rows
        for name in re.finditer(r"`([^`]+)`", row[1])
    }
