"""Commands of other libraries at once on a GPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from benchmarks.evaluation.figures import NOT_MEASURED, figure, link, markdown, origin, shown
from benchmarks.records import RESULTS, Call, calls_by_date

_ALONE = "1 at once, mps"
_HEAD = (
    "training | at once | steps/s while all report: | over one: | trainings per hour: | over one:"
)


def packs() -> list[str]:
    """Steps per second and trainings per hour of every training, by number at once.

    The newest call of each training counts; a ratio is of one call.
    """
    newest: dict[str, Call] = {}
    files: dict[str, str] = {}
    for call, path in calls_by_date(RESULTS, "packs-*.json"):
        for row in call.results.get("rows", ()):
            newest[row["name"]], files[row["name"]] = call, path.name
    rows = [cells for name, call in newest.items() for cells in _of_training(name, call)]
    found = {(files[name], call.date): call for name, call in newest.items()}
    calls = [f"- {link(file)}: {origin(call)}" for (file, _), call in found.items()]
    return [*markdown(_HEAD, rows), "", *(calls or [f"- `packs-*.json`: {NOT_MEASURED}"])]


class Packed(NamedTuple):
    """Eight trainings of another library at once, over one alone.

    Attributes:
      name: of the training.
      steps_per_s: ratio of steps per second.
      trainings_per_hour: ratio of finished trainings per hour, start-up included.
    """

    name: str
    steps_per_s: float
    trainings_per_hour: float


def packed() -> Packed | None:
    """Of the newest call; None without one."""
    calls = calls_by_date(RESULTS, "packs-nvidia-*.json")
    rows = calls[-1][0].results.get("rows", ()) if calls else ()
    found = {row["way"]: row for row in rows if row.get("exit_code") == 0}
    eight, alone = found.get("8 at once, mps"), found.get(_ALONE)
    if eight is None or alone is None:
        return None
    ratios = (eight[key] / alone[key] for key in ("steps_per_s", "trainings_per_hour"))
    return Packed(eight["name"].split(",")[0], *ratios)


def packed_gains() -> str:
    """In words, what the training with the most at once gains."""
    found = packed()
    if found is None:
        return NOT_MEASURED
    return (
        f"eight at once of {found.name}: {found.steps_per_s:.2f} times the steps/s of one, "
        f"{found.trainings_per_hour:.2f} times the trainings per hour (n=1)"
    )


def _of_training(name: str, call: Call) -> list[list[str]]:
    by_way: dict[str, list[Mapping[str, Any]]] = {}
    for row in call.results.get("rows", ()):
        if row["name"] == name and row.get("exit_code") == 0:
            by_way.setdefault(row["way"], []).append(row)
    alone = by_way.get(_ALONE, [])
    rows = []
    for way, own in by_way.items():
        cells = [name if not rows else "", way]
        for key, form in (("steps_per_s", ",.0f"), ("trainings_per_hour", ",.1f")):
            rate, base = figure(_values(own, key)), figure(_values(alone, key))
            over = rate.median / base.median if rate and base else None
            cells += [shown(rate, form), shown(over)]
        rows.append(cells)
    return rows


def _values(rows: Sequence[Mapping[str, Any]], key: str) -> list[float]:
    return [row[key] for row in rows if row.get(key) is not None]
