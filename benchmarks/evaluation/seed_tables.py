"""How many seeds of a setting succeed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from benchmarks.evaluation.figures import link, markdown, origin, shown
from benchmarks.records import RESULTS, calls_by_date

PATTERN = "seeds-*-nvidia-*.json"
HEAD = (
    "task | call: | changed | successes: | interval of 95 %: | p: | reward of a step in the end:"
)


def seeds() -> list[str]:
    """Successes of every setting whose seeds all ran, by task and call; calls in order of date."""
    found = sorted(calls_by_date(RESULTS, PATTERN), key=lambda one: one[0].results["task"])
    rows, calls, number = [], [], Counter[str]()
    for call, path in found:
        task = call.results["task"]
        number[task] += 1
        finished = [row for row in call.results["rows"] if not row["unfinished"]]
        rows += [_cells(task, number[task], row) for row in finished]
        calls.append(f"- {link(path.name)}, call {number[task]}: {origin(call)}")
    return [*markdown(HEAD, rows), "", *calls]


def _cells(task: str, number: int, row: Mapping[str, Any]) -> list[str]:
    changed = ", ".join(f"`{override}`" for override in row["overrides"]) or "nothing"
    low, high = row["wilson"]
    least, median, most = row["final"]
    return [
        *(f"`{task}`", str(number), changed, f"{row['successes']} of {row['seeds']}"),
        f"{low:.0%} to {high:.0%}",
        shown(row["p_successes"], ".2g") if "p_successes" in row else "",
        f"{median:.3g} ({least:.3g} to {most:.3g})",
    ]
