"""What two GMIs of one GPU gain over one program, where one acts and the other learns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.evaluation.figures import NOT_MEASURED, figure, shown
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.records import RESULTS, Call, calls_by_date

HEAD = (
    "task | environments, updates, batch | one program: rounds/s: | updates/s: | "
    "two GMIs, ratio held: | as fast as each can: rounds: | updates: | "
    "over one program at their ratio, computed:"
)
_SETTINGS = ("num_envs", "updates_per_step", "batch_size")


@lines("off-policy")
def off_policy() -> list[str]:
    """The newest call of every task, GPU and size."""
    newest: dict[Any, tuple[Call, Path]] = {}
    for call, path in calls_by_date(RESULTS, "off-policy-*-nvidia-*.json"):
        resolved = call.results["resolved"]
        size = tuple(resolved[key] for key in _SETTINGS)
        newest[(_task(call), call.device, size)] = call, path
    if not newest:
        return [NOT_MEASURED]
    rows = [
        [
            f"`{task}`",
            ", ".join(f"{number:,}" for number in size),
            *_cells(call.results["repeats"]),
        ]
        for (task, _, size), (call, _) in sorted(newest.items(), key=lambda item: item[0])
    ]
    files = [f"- {link(path.name)}: {origin(call)}" for call, path in newest.values()]
    return [*markdown(HEAD, rows), "", *dict.fromkeys(files)]


def _task(call: Call) -> str:
    assert call.settings is not None
    overrides = call.settings["overrides"]
    return next(one.removeprefix("env=") for one in overrides if one.startswith("env="))


def _cells(repeats: Sequence[Mapping[str, Any]]) -> list[str]:
    under_mps = [one for one in repeats if one["backend"] == "mps"]
    alone = [one["in_turn"] for one in under_mps]
    gains = [one["gain"] for one in under_mps]
    return [
        shown(figure([one["rounds_per_s"] for one in alone]), ".0f"),
        shown(figure([one["updates_per_s"] for one in alone]), ".0f"),
        *(
            shown(figure([one[key] for one in gains]))
            for key in ("held", "rounds_free", "updates_free")
        ),
        shown(figure([over_the_same_ratio(one) for one in under_mps])),
    ]


def over_the_same_ratio(repeat: Mapping[str, Any]) -> float:
    """Two GMIs that wait for nobody, over one program with their ratio of updates to rounds.

    That program is not run: it would take the seconds of a round and those of its updates, each as
    measured alone in one program.
    """
    two, one = repeat["two_gmis"], repeat["in_turn"]
    updates = two["free_updates_per_s"] / two["free_rounds_per_s"]
    round_s = 1 / one["acting_alone_rounds_per_s"]
    return two["free_rounds_per_s"] * (round_s + updates / one["learning_alone_updates_per_s"])
