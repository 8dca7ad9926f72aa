"""How long robots are trained until they walk."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.evaluation.figures import NOT_MEASURED
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.records import RESULTS, Call, calls_by_date
from benchmarks.walking import SCRIPT

PATTERN = "walking-*-nvidia-*.json"
HEAD = (
    "task | trained by | programs | seeds that walk: | million steps: | seconds of training: | "
    "seconds of the command: | at the end: million steps: | do not fall: | error, m/s: | rad/s:"
)


@lines("walking")
def walking() -> list[str]:
    """The newest call of each task, algorithm, GPU and start: median, least and most of seeds."""
    newest: dict[Any, tuple[Call, Path]] = {}
    for call, path in calls_by_date(RESULTS, PATTERN):
        assert call.settings is not None
        kind = call.results["task"], _algo(call), call.device, call.settings["cold"]
        newest[kind] = call, path
    if not newest:
        return [NOT_MEASURED]
    rows = [
        [
            f"`{task}`",
            trainer if trainer == SCRIPT else f"{trainer} {algo}",
            "compiled anew" if is_cold else "from the cache",
            *_cells(row),
            *_end(call, trainer),
        ]
        for (task, algo, _, is_cold), (call, _) in sorted(newest.items(), key=lambda item: item[0])
        for trainer, row in call.results["rows"].items()
    ]
    files = [f"- {link(path.name)}: {origin(call)}" for call, path in newest.values()]
    return [*markdown(HEAD, rows), "", *files]


def _algo(call: Call) -> str:
    """Of our trainings, as it is written."""
    assert call.settings is not None
    given = dict(word.split("=", 1) for word in call.settings["overrides"])
    return given.get("algo", "ppo").upper()


def _cells(row: Mapping[str, Any]) -> list[str]:
    return [
        f"{row['walk']} of {row['seeds']}",
        _spread(row["env_steps"], 1e-6),
        _spread(row["training_s"]),
        _spread(row["command_s"]),
    ]


def _end(call: Call, trainer: str) -> list[str]:
    """The last test of every training: medians over seeds."""
    runs = [run["checkpoints"] for run in call.results["runs"] if run["trainer"] == trainer]
    tested = [[one for one in checkpoints if "walk" in one] for checkpoints in runs]
    last = [checkpoints[-1] for checkpoints in tested if checkpoints]
    walks = [one["walk"] for one in last]
    figures = [
        ("{:.0f}", [one["env_steps"] / 1e6 for one in last]),
        ("{:.1%}", [walk["upright"] for walk in walks]),
        ("{:.2f}", [walk["settled"]["linear_m_per_s"] for walk in walks]),
        ("{:.2f}", [walk["settled"]["yaw_rad_per_s"] for walk in walks]),
    ]
    # None: all have left the field, or fallen at once.
    known = [(form, [value for value in values if value is not None]) for form, values in figures]
    return [form.format(statistics.median(values)) if values else "" for form, values in known]


def _spread(values: Sequence[float] | None, scale: float = 1.0) -> str:
    if values is None:
        return ""
    least, median, most = (f"{value * scale:.0f}" for value in values)
    return f"{median} ({least} to {most})"
