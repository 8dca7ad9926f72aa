"""The table beside other libraries."""

from __future__ import annotations

from benchmarks.evaluation.figures import NOT_MEASURED, link, markdown, origin
from benchmarks.peers.comparisons import COMPARISONS
from benchmarks.peers.table import HEAD, measured, row
from benchmarks.records import RESULTS, read_calls

PEERS = "peers-nvidia-h200"


def peers() -> list[str]:
    """Every comparison from the newest call that measured both of its sides."""
    path = RESULTS / f"{PEERS}.json"
    if not path.exists():
        return [f"{'; '.join(COMPARISONS)}: {NOT_MEASURED} (`python -m benchmarks.peers`)."]
    calls = read_calls(path)
    rows, origins = [], {}
    for name in COMPARISONS:
        call = next((one for one in reversed(calls) if measured(one.results, name)), None)
        rows.append(row(call.results if call else {}, name))
        if call:
            origins.setdefault(origin(call), []).append(name)
    file = link(path.name)
    lines = [f"- {file}, {'; '.join(names)}: {made}" for made, names in origins.items()]
    return [*markdown(HEAD, rows), "", *lines]
