"""What the sides of each comparison made, in one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.evaluation.figures import Figure, figure, shown
from benchmarks.peers.comparisons import COMPARISONS, MJLAB

OURS = "gmijax"
HEAD = (
    "training run | beside | `gmijax.train`, steps/s: | the other, steps/s: | ratio: "
    "| seconds of the command, `gmijax.train`: | the other:"
)


def case_name(comparison: str, trainer: str) -> str:
    """Under which the runs of one side stand."""
    return f"{comparison}, {trainer}"


def measured(results: Mapping[str, Any], comparison: str) -> bool:
    """Whether both sides of a comparison have a run."""
    trainers = (OURS, COMPARISONS[comparison].peer)
    return all(_figure(results, comparison, trainer, "steps_per_s") for trainer in trainers)


def ratio(results: Mapping[str, Any], comparison: str) -> float | None:
    """Steps per second of `gmijax.train` over those of the other side."""
    trainers = (OURS, COMPARISONS[comparison].peer)
    ours, theirs = (_figure(results, comparison, one, "steps_per_s") for one in trainers)
    return ours.median / theirs.median if ours and theirs else None


def row(results: Mapping[str, Any], comparison: str) -> list[str]:
    """Cells of a comparison, medians of what was measured."""
    peer = COMPARISONS[comparison].peer
    rates, seconds = (
        [_figure(results, comparison, trainer, key) for trainer in (OURS, peer)]
        for key in ("steps_per_s", "command_s")
    )
    cells = [shown(value, ",.0f") for value in rates]
    cells.append("another task" if peer == MJLAB else shown(ratio(results, comparison)))
    return [comparison, peer, *cells, *(shown(value, ".1f") for value in seconds)]


def _figure(results: Mapping[str, Any], comparison: str, trainer: str, key: str) -> Figure | None:
    runs = results.get("cases", {}).get(case_name(comparison, trainer), {}).get("runs", ())
    return figure([run["summary"][key] for run in runs if "summary" in run])
