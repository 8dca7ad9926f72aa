"""The table beside other libraries."""

from __future__ import annotations

from benchmarks.evaluation.figures import NOT_MEASURED, link, markdown, origin
from benchmarks.peers.comparisons import COMPARISONS
from benchmarks.peers.table import HEAD, measured, row
from benchmarks.records import RESULTS, read_calls

PATTERN = "peers-nvidia-*.json"


def peers() -> list[str]:
    """Every comparison from the newest call that measured both of its sides."""
    calls = sorted(
        ((call, path) for path in RESULTS.glob(PATTERN) for call in read_calls(path)),
        key=lambda pair: str(pair[0].date),
    )
    if not calls:
        return [f"{'; '.join(COMPARISONS)}: {NOT_MEASURED} (`python -m benchmarks.peers`)."]
    rows: list[list[str]] = []
    origins: dict[str, list[str]] = {}
    for name in COMPARISONS:
        found = next((one for one in reversed(calls) if measured(one[0].results, name)), None)
        rows.append(row(found[0].results if found else {}, name))
        if found:
            origins.setdefault(f"{link(found[1].name)}|{origin(found[0])}", []).append(name)
    lines = [
        f"- {file}, {'; '.join(names)}: {made}"
        for (file, made), names in ((key.split("|"), names) for key, names in origins.items())
    ]
    return [*markdown(HEAD, rows), "", *lines]
