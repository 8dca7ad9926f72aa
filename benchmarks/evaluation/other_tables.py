"""The tables beside training: searches, reductions, faults, checks of a GPU."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.evaluation.evidence import Evidence, FigureText, Ratio, source
from benchmarks.evaluation.figures import (
    NOT_MEASURED,
    Figure,
    bounds,
    figure,
    results_of,
    shown,
    sources_of,
    text_of_range,
)
from benchmarks.evaluation.writer import (
    Calls,
    Rows,
    newest,
    table,
    table_of_calls,
)
from benchmarks.records import RESULTS, Call, calls_by_date, read_calls


def _searches() -> Calls:
    """By task, the newest call that searched it."""
    found: dict[str, tuple[Call, Path]] = {}
    for call, path in calls_by_date("searches-*.json"):
        found |= {row["env"]: (call, path) for row in call.results["rows"] if "best" in row}
    return found


def text_of_searches() -> FigureText:
    """What the searches on one GPU chose, each once, and how long they took."""
    sources = frozenset(source(path.stem, call) for call, path in _searches().values())
    rows = answers()
    if not rows:
        return FigureText(NOT_MEASURED, None)
    chosen = (
        f"`{task}` {best['gmis_per_gpu']} x {best['num_envs']:,} ({best['impl']})"
        for task, best in ((task, row["best"]) for task, row in rows.items())
    )
    seconds = bounds([row["wall_s"] for row in rows.values()], ".0f")
    return FigureText(f"{', '.join(chosen)}; {seconds} s", Evidence(1, sources))


def answers() -> dict[str, Mapping[str, Any]]:
    """What the newest search of each task found."""
    rows = {}
    for task, (call, _) in sorted(_searches().items()):
        rows[task] = next(row for row in call.results["rows"] if row.get("env") == task)
    return rows


@table_of_calls(
    "search",
    "task | answer: GMIs x environments | MJX | its steps/s: | over the best point: | "
    "over the best point with one GMI: | profiles: | seconds:",
    _searches,
)
def search(_: Calls) -> Rows:
    """What Algorithm 2 chooses, beside the points that it measured."""
    for task, row in answers().items():
        best, points = row["best"], [p for p in row["points"] if p.get("projected")]
        alone = [p["projected"] for p in points if p["gmis_per_gpu"] == 1]
        yield [
            *(f"`{task}`", f"{best['gmis_per_gpu']} x {best['num_envs']:,}", best["impl"]),
            f"{best['projected']:,.0f}",
            shown(best["projected"] / max(p["projected"] for p in points)),
            shown(best["projected"] / max(alone) if alone else None),
            *(str(len(row["points"])), f"{row['wall_s']:.0f}"),
        ]


REDUCTION_HEAD = (
    "GPUs x GMIs | exchange | alone, ms: | 10 to 90 %: | in a chain, ms: | over the model:"
)


def reductions() -> Calls:
    """The newest call of `benchmarks.reduction` on GPUs."""
    return newest("reduction-nvidia-*.json", lambda _: "newest")


@table_of_calls("reduction", REDUCTION_HEAD, reductions)
def reduction(calls: Calls) -> Rows:
    """A mean of 1.5 million numbers, alone and in a chain."""
    rows = [row for call, _ in calls.values() for row in call.results["rows"]]
    return [reduction_row(row) for row in rows if row["num_floats"] == 1_500_000]


def reduction_row(row: Mapping[str, Any]) -> list[str]:
    """A mean by one way of exchange."""
    keys = ("median_s", "p10_s", "p90_s", "chained_s")
    alone, low, high, chained = (f"{1e3 * row[key]:.3f}" for key in keys)
    fit = row["median_s"] / row["predicted_s"] if row["predicted_s"] else None
    name = [read_layout(row["layout"]), f"`{row['name']}`"]
    return [*name, alone, f"{low} to {high}", chained, shown(fit)]


def read_layout(text: str) -> str:
    """`2 x 3` of `[[0,1,2],[3,4,5]]`."""
    gpus = text.split("],[")
    return f"{len(gpus)} x {gpus[0].count(',') + 1}"


def model_fit() -> FigureText:
    """Measured over predicted time of all reductions of the paper's strategies, in one call."""
    fits = [
        Ratio(
            row["median_s"] / row["predicted_s"],
            Evidence(1, frozenset([source(path.stem, call)])),
        )
        for call, path in reductions().values()
        for row in call.results["rows"]
        if row["predicted_s"]
    ]
    return text_of_range(fits, ".3g")


FAULTS = MappingProxyType(
    {
        "oom": "a GMI runs out of GPU memory",
        "stuck": "a GMI hangs",
        "daemon": "the MPS daemon dies",
        "kill": "`kill -9` of a GMI",
    }
)
"""Kind of a fault in the file -> what happens."""


@table("faults", "fault | seconds until all GMIs train again:", "faults-h200")
def faults() -> Rows:
    """Seconds from a fault until all GMIs train again."""
    return [[FAULTS[kind], shown(found, ".0f")] for kind, found in seconds_to_recover().items()]


def seconds_to_recover() -> dict[str, Figure | None]:
    """By kind of fault."""
    kinds: dict[str, list[float]] = {}
    for row in results_of("faults-h200").get("rows", ()):
        kinds.setdefault(row["fault"], []).append(row["seconds"])
    return {kind: figure(s, *sources_of("faults-h200")) for kind, s in kinds.items()}


@table(
    "faults-cpu",
    "faults of | kinds: | unexpected: | lost: | leaked: | seconds a fault:",
    "faults-cpu",
)
def faults_on_a_cpu() -> Rows:
    """Faults of every command, and how many came to something else than they must."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in _rows_of_faults():
        groups.setdefault(row["group"], []).append(row)
    for group, found in sorted(groups.items()):
        trials = {row["trial"]: row for row in found}.values()  # One may have several faults.
        unexpected = sum(row["outcome"] != "as wanted" for row in found)
        sums = (sum(len(row[what]) for row in trials) for what in ("lost", "leaked"))
        counts = (f"{count} of {len(found)}" for count in (unexpected, *sums))
        seconds = shown(figure([row["seconds"] for row in found]), ".0f")
        kinds = len({row["kind"] for row in found})
        yield [group, str(kinds), *counts, seconds]


def _rows_of_faults() -> Iterator[Mapping[str, Any]]:
    """Of all calls of the newest commit, each with seeds of its own."""
    path = RESULTS / "faults-cpu.json"
    calls = read_calls(path) if path.exists() else []
    for call in (one for one in calls if one.commit == calls[-1].commit):
        for row in call.results.get("rows", ()):
            yield {**row, "trial": (call.date, row["trial"])}
