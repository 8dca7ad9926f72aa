"""Two nodes of one GPU each beside one node with both GPUs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

from benchmarks.evaluation.evidence import Evidence, FigureText, Ratio, source
from benchmarks.evaluation.figures import TRAINING, Figure, figure, over, shown, text_of_range
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.records import calls_by_date

ONE_NODE = "one node"
TWO_NODES = MappingProxyType(
    {
        "nccl": "two nodes, NCCL",
        "sockets": "two nodes, NCCL over sockets",
        "tcp": "two nodes, TCP",
        "jobs": "two nodes, each job on one",
    }
)
"""What tables call the two nodes, by how they exchange."""

HEAD = (
    "job | nodes | exchange | steps/s: | over one node: | exchanges of an iteration, ms: | "
    "trainings per hour: | over one node:"
)

Ways: TypeAlias = Mapping[str, Mapping[str, Any]]
"""The cases of one job, by way."""


def _by_job(results: Mapping[str, Any]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Cases with a run that succeeded, by job, then by way."""
    found: dict[str, dict[str, Mapping[str, Any]]] = {}
    for case in results.get("cases", {}).values():
        runs = [run for run in case["runs"] if "summary" in run]
        if runs:
            found.setdefault(case["job"], {})[case["way"]] = {**case, "runs": runs}
    return found


def _rate(ways: Ways, way: str, key: str) -> Figure | None:
    runs = ways[way]["runs"] if way in ways else ()
    values = [run["summary"].get(key) for run in runs]
    return figure([value for value in values if value is not None])


def over_one_node(ways: Ways, way: str, key: str = TRAINING) -> Ratio | None:
    """A rate of a way over that of one node, of one call."""
    return over(_rate(ways, way, key), _rate(ways, ONE_NODE, key))


def rows_of(results: Mapping[str, Any]) -> Rows:
    """All jobs of a call."""
    for job, ways in _by_job(results).items():
        yield from _rows(job, ways)


def _rows(job: str, ways: Ways) -> Rows:
    for number, (way, case) in enumerate(ways.items()):
        cells = [
            cell
            for key, form in ((TRAINING, ",.0f"), ("trainings_per_hour", ",.1f"))
            for cell in _cells(ways, way, key, form)
        ]
        yield [
            "" if number else job,
            way,
            _exchange(case),
            *cells[:2],
            _exchanges_ms(case),
            *cells[2:],
        ]


def _cells(ways: Ways, way: str, key: str, form: str) -> list[str]:
    """A rate and its ratio, which one training at a time does not have per hour."""
    found = _rate(ways, way, key)
    if found is None:
        return ["", ""]
    return [shown(found, form), "1" if way == ONE_NODE else shown(over_one_node(ways, way, key))]


def _exchange(case: Mapping[str, Any]) -> str:
    """Strategy, inside a GPU, between nodes, and what NCCL took between GPUs."""
    plan, via = case["runs"][0]["summary"].get("plan"), case["runs"][0].get("via")
    parts = [plan[key] for key in ("strategy", "intra", "inter") if plan.get(key)] if plan else []
    return ", ".join([*(f"`{part}`" for part in parts), *(via or ())])


def _exchanges_ms(case: Mapping[str, Any]) -> str:
    seconds = (run.get("medians", {}).get("time/reduce_s") for run in case["runs"])
    found = figure([1e3 * value for value in seconds if value is not None])
    return shown(found, ".2f") if found else ""


def _newest() -> Calls:
    """Of every job the newest call that ran it on one node and on two."""
    return {
        job: (call, path)
        for call, path in calls_by_date("nodes-nvidia-*.json")
        for job, ways in _by_job(call.results).items()
        if ONE_NODE in ways and len(ways) > 1
    }


@table_of_calls("nodes", HEAD, _newest, is_brief=True)
def nodes(calls: Calls) -> Rows:
    """Every job, on one node and on two."""
    for job, (call, _) in calls.items():
        yield from _rows(job, _by_job(call.results)[job])


def two_nodes_over_one() -> dict[str, FigureText]:
    """Steps/s of two nodes over those of one, by a key of `TWO_NODES`."""
    found: dict[str, list[Ratio | None]] = {}
    for job, (call, path) in _newest().items():
        ways, sources = _by_job(call.results)[job], frozenset([source(path.stem, call)])
        for way in ways:
            if (gain := over_one_node(ways, way)) is not None:
                of = Evidence(gain.evidence.repeats, sources)
                found.setdefault(way, []).append(Ratio(gain, of))
    return {key: text_of_range(found.get(way, ())) for key, way in TWO_NODES.items()}
