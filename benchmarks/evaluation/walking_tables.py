"""How long robots are trained until they walk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.evaluation.figures import NOT_MEASURED
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.records import RESULTS, Call, calls_by_date

PATTERN = "walking-*-nvidia-*.json"
HEAD = (
    "task | trained by | programs | seeds that walk: | million steps: | seconds of training: | "
    "seconds of the command:"
)


@lines("walking")
def walking() -> list[str]:
    """The newest call of every task, GPU and kind of start: median, least and most of seeds."""
    newest: dict[Any, tuple[Call, Path]] = {}
    for call, path in calls_by_date(RESULTS, PATTERN):
        assert call.settings is not None
        newest[(call.results["task"], call.device, call.settings["cold"])] = call, path
    if not newest:
        return [NOT_MEASURED]
    rows = [
        [f"`{task}`", trainer, "compiled anew" if is_cold else "from the cache", *_cells(row)]
        for (task, _, is_cold), (call, _) in sorted(newest.items(), key=lambda item: item[0])
        for trainer, row in call.results["rows"].items()
    ]
    files = [f"- {link(path.name)}: {origin(call)}" for call, path in newest.values()]
    return [*markdown(HEAD, rows), "", *files]


def _cells(row: Mapping[str, Any]) -> list[str]:
    return [
        f"{row['walk']} of {row['seeds']}",
        _spread(row["env_steps"], 1e-6),
        _spread(row["training_s"]),
        _spread(row["command_s"]),
    ]


def _spread(values: Sequence[float] | None, scale: float = 1.0) -> str:
    if values is None:
        return ""
    least, median, most = (f"{value * scale:.0f}" for value in values)
    return f"{median} ({least} to {most})"
