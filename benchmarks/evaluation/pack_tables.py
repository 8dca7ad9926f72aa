"""Commands of other libraries at once on a GPU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from benchmarks.evaluation.evidence import Ratio, source
from benchmarks.evaluation.figures import Figure, figure, over, shown
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.records import Call, calls_by_date
from benchmarks.steady import are_alike

_STEPS, _FINISHED = "steps_per_s", "trainings_per_hour"
MJLAB: Final = "mjlab Go1, 4096 environments, 30 iterations"
CLEANRL: Final = "CleanRL PPO, gmijax ant, 2048 environments"


class _Training:
    """The packs of one training in one call, by number at once.

    Attributes:
      ways: the rows of each way, in the order of the file.
    """

    def __init__(self, call: Call, path: Path, name: str) -> None:
        self._source = source(path.stem, call)
        self.ways: dict[str, list[Mapping[str, Any]]] = {}
        for row in _succeeded(call):
            if row["name"] == name:
                self.ways.setdefault(row["way"], []).append(row)

    def rate(self, way: str, key: str) -> Figure | None:
        """A rate over the repeats of a way."""
        rates = [row[key] for row in self.ways.get(way, ()) if row.get(key) is not None]
        return figure(rates, self._source)

    def over_one(self, way: str, key: str) -> Ratio | None:
        """A rate over that of one at a time."""
        alone = next((one for one in self.ways if one.startswith("1 ")), "")
        return over(self.rate(way, key), self.rate(alone, key))

    def last_metric(self, way: str) -> Figure | None:
        """The last one that jobs of a way printed, over all of them."""
        curves = [curve for row in self.ways[way] for curve in row.get("curves") or ()]
        return figure([curve[-1][1] for curve in curves if curve])


def _succeeded(call: Call) -> list[Mapping[str, Any]]:
    return [row for row in call.results.get("rows", ()) if row.get("exit_code") == 0]


def _of_trainings() -> Calls:
    """Of every training the newest call."""
    calls = calls_by_date("packs-nvidia-*.json")
    return {row["name"]: (call, path) for call, path in calls for row in _succeeded(call)}


@table_of_calls(
    "packs",
    "training | at once | steps/s in all: | over one: | trainings per hour: | "
    "over one: | reward at the end:",
    _of_trainings,
    lambda training: training,
)
def packs(calls: Calls) -> Rows:
    """Steps per second and trainings per hour of every training, by number at once."""
    for name, (call, path) in calls.items():
        training = _Training(call, path, name)
        rows = [row for rows in training.ways.values() for row in rows]
        has_curves = any(row.get("curves") for row in rows)
        is_mix = not all(are_alike(row["jobs"]) for row in rows)  # Its steps do not add up.
        for number, way in enumerate(training.ways):
            cells = [
                *(
                    shown(training.rate(way, _STEPS), ",.0f"),
                    shown(training.over_one(way, _STEPS)),
                ),
                shown(training.rate(way, _FINISHED), ",.1f"),
                shown(training.over_one(way, _FINISHED)),
                shown(training.last_metric(way), ".1f") if has_curves else "",
            ]
            if is_mix:
                cells[:2] = "", ""
            yield ["" if number else name, _shown_way(way), *cells]


def _shown_way(way: str) -> str:
    """`3, one after another, mps` of `1 of 3 at once, mps`, and so for `auto`."""
    found = re.fullmatch(r"(1|auto) of (\d+) at once, (\w+)", way)
    if found is None:
        return way
    at_once, copies, backend = found.groups()
    return f"{copies}, " + (f"one after another, {backend}" if at_once == "1" else "by `auto`")


def eight_packed(name: str) -> dict[str, Ratio | None]:
    """What eight of a training at once gain over one, in its newest call."""
    calls = _of_trainings()
    if name not in calls:
        return {"steps": None, "finished": None}
    training = _Training(*calls[name], name)
    gains = (training.over_one("8 at once, mps", key) for key in (_STEPS, _FINISHED))
    return dict(zip(("steps", "finished"), gains, strict=True))
