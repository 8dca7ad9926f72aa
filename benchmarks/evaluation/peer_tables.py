"""The table beside other libraries."""

from __future__ import annotations

from pathlib import Path

from benchmarks.evaluation.figures import NOT_MEASURED
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.peers.comparisons import BRAX, COMPARISONS
from benchmarks.peers.table import HEAD, measured, ratio, row
from benchmarks.records import RESULTS, Call, calls_by_date

PATTERN = "peers-nvidia-*.json"


@lines("peers")
def peers() -> list[str]:
    """Every comparison from the newest call that measured both of its sides."""
    calls = calls_by_date(RESULTS, PATTERN)
    if not calls:
        return [f"{'; '.join(COMPARISONS)}: {NOT_MEASURED} (`python -m benchmarks.peers`)."]
    rows: list[list[str]] = []
    origins: dict[tuple[str, str], list[str]] = {}
    for name in COMPARISONS:
        call, path = _newest(name) or (None, None)
        rows.append(row(call.results if call else {}, name))
        if call and path:
            origins.setdefault((link(path.name), origin(call)), []).append(name)
    files = [f"- {file}, {'; '.join(names)}: {made}" for (file, made), names in origins.items()]
    return [*markdown(HEAD, rows), "", *files]


def over_brax() -> list[float | None]:
    """Steps per second over those of Brax's PPO, of every comparison."""
    names = [name for name, one in COMPARISONS.items() if one.peer == BRAX]
    return [ratio(found[0].results, name) for name in names if (found := _newest(name))]


def _newest(comparison: str) -> tuple[Call, Path] | None:
    """The newest call that measured both sides."""
    calls = reversed(calls_by_date(RESULTS, PATTERN))
    return next((one for one in calls if measured(one[0].results, comparison)), None)
