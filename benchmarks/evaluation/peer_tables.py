"""The table beside other libraries."""

from __future__ import annotations

from benchmarks.evaluation.figures import NOT_MEASURED, link, markdown, origin
from benchmarks.peers.comparisons import COMPARISONS
from benchmarks.peers.table import HEAD, measured, row
from benchmarks.records import RESULTS, calls_by_date

PATTERN = "peers-nvidia-*.json"


def peers() -> list[str]:
    """Every comparison from the newest call that measured both of its sides."""
    calls = calls_by_date(RESULTS, PATTERN)
    if not calls:
        return [f"{'; '.join(COMPARISONS)}: {NOT_MEASURED} (`python -m benchmarks.peers`)."]
    rows: list[list[str]] = []
    origins: dict[tuple[str, str], list[str]] = {}
    for name in COMPARISONS:
        newest = (one for one in reversed(calls) if measured(one[0].results, name))
        call, path = next(newest, (None, None))
        rows.append(row(call.results if call else {}, name))
        if call and path:
            origins.setdefault((link(path.name), origin(call)), []).append(name)
    lines = [f"- {file}, {'; '.join(names)}: {made}" for (file, made), names in origins.items()]
    return [*markdown(HEAD, rows), "", *lines]
