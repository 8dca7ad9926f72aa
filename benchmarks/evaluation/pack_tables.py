"""Commands of other libraries at once on a GPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from benchmarks.evaluation.figures import NOT_MEASURED, Figure, figure, over, shown
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.records import RESULTS, Call, calls_by_date
from benchmarks.steady import are_alike

_HEAD = (
    "training | at once | steps/s while all report: | over one: | trainings per hour: | over one:"
)
_STEPS, _FINISHED = "steps_per_s", "trainings_per_hour"
_IN_README: Final = (
    ("mjlab Go1, 4096 environments, 30 iterations", "mjlab Go1"),
    ("CleanRL PPO, gmijax ant, 2048 environments", "CleanRL's PPO"),
)


class _Training(NamedTuple):
    """The packs of one training in one call, by number at once."""

    call: Call
    file: str
    ways: Mapping[str, Sequence[Mapping[str, Any]]]

    @property
    def is_mix(self) -> bool:
        """Whether its jobs are of several kinds, whose steps do not add up."""
        return not all(are_alike(row["jobs"]) for rows in self.ways.values() for row in rows)

    def rate(self, way: str, key: str) -> Figure | None:
        """A rate over the repeats of a way."""
        return figure([row[key] for row in self.ways.get(way, ()) if row.get(key) is not None])

    def over_one(self, way: str, key: str) -> float | None:
        """A rate over that of one at a time."""
        alone = next((one for one in self.ways if one.startswith("1 ")), "")
        return over(self.rate(way, key), self.rate(alone, key))


@lines("packs")
def packs() -> list[str]:
    """Steps per second and trainings per hour of every training, by number at once.

    The newest call of each training counts; a ratio is of one call.
    """
    found = _trainings()
    rows = [cells for name, training in found.items() for cells in _rows(name, training)]
    calls = {(one.file, one.call.date): one.call for one in found.values()}
    files = [f"- {link(file)}: {origin(call)}" for (file, _), call in calls.items()]
    return [*markdown(_HEAD, rows), "", *(files or [f"- `packs-*.json`: {NOT_MEASURED}"])]


class Packed(NamedTuple):
    """Eight trainings of another library at once, over one alone.

    Attributes:
      name: of the training.
      steps_per_s: ratio of steps per second.
      trainings_per_hour: ratio of finished trainings per hour, start-up included.
      repeats: of both.
    """

    name: str
    steps_per_s: float
    trainings_per_hour: float
    repeats: int


def packed() -> list[Packed]:
    """Of the newest calls; nothing without one."""
    found, way = _trainings(), "8 at once, mps"
    gains = []
    for name, title in _IN_README:
        training = found.get(name)
        if training is None:
            continue
        steps, finished = (training.over_one(way, key) for key in (_STEPS, _FINISHED))
        if steps is not None and finished is not None:
            gains.append(Packed(title, steps, finished, len(training.ways[way])))
    return gains


def packed_gains() -> str:
    """In words, what eight at once gain."""
    parts = [
        f"{one.name} {one.steps_per_s:.2f} and {one.trainings_per_hour:.2f} (n={one.repeats})"
        for one in packed()
    ]
    if not parts:
        return NOT_MEASURED
    return f"eight at once over one, in steps/s and in trainings per hour: {', '.join(parts)}"


def _trainings() -> dict[str, _Training]:
    found: dict[str, _Training] = {}
    for call, path in calls_by_date(RESULTS, "packs-nvidia-*.json"):
        rows = [row for row in call.results.get("rows", ()) if row.get("exit_code") == 0]
        for name in dict.fromkeys(row["name"] for row in rows):
            ways: dict[str, list[Mapping[str, Any]]] = {}
            for row in rows:
                if row["name"] == name:
                    ways.setdefault(row["way"], []).append(row)
            found[name] = _Training(call, path.name, ways)
    return found


def _rows(name: str, training: _Training) -> list[list[str]]:
    rows = []
    for way in training.ways:
        cells = [name if not rows else "", way]
        for key, form in ((_STEPS, ",.0f"), (_FINISHED, ",.1f")):
            gained = shown(training.rate(way, key), form), shown(training.over_one(way, key))
            cells += ("", "") if training.is_mix and key == _STEPS else gained
        rows.append(cells)
    return rows
