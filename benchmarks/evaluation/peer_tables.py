"""The table beside other libraries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.evaluation.evidence import Ratio, Source, source
from benchmarks.evaluation.figures import Figure, figure, over, shown
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.peers.comparisons import BRAX, COMPARISONS, MJLAB, OURS, case_name
from benchmarks.records import calls_by_date

HEAD = (
    "training run | beside | `gmijax.train`, steps/s: | the other, steps/s: | ratio: "
    "| seconds of the command, `gmijax.train`: | the other:"
)


def measured() -> Calls:
    """Of every comparison the newest call that measured both of its sides."""
    calls = calls_by_date("peers-nvidia-*.json")
    return {
        name: call
        for name in COMPARISONS
        for call in calls
        if all(_both(call[0].results, name, "steps_per_s"))
    }


@table_of_calls("peers", HEAD, measured, note=str)
def peers(calls: Calls) -> Rows:
    """Every comparison."""
    for name in COMPARISONS:
        yield row(calls[name][0].results if name in calls else {}, name)


def row(results: Mapping[str, Any], comparison: str) -> list[str]:
    """Cells of a comparison, medians of what was measured."""
    peer = COMPARISONS[comparison].peer
    rates = [shown(value, ",.0f") for value in _both(results, comparison, "steps_per_s")]
    seconds = [shown(value, ".1f") for value in _both(results, comparison, "command_s")]
    gain = "another task" if peer == MJLAB else shown(_ratio(results, comparison))
    return [comparison, peer, *rates, gain, *seconds]


def over_brax() -> list[Ratio]:
    """Steps per second over those of Brax's PPO, of every comparison."""
    calls = {name: call for name, call in measured().items() if COMPARISONS[name].peer == BRAX}
    found = (
        _ratio(call.results, name, source(path.stem, call)) for name, (call, path) in calls.items()
    )
    return [one for one in found if one is not None]


def our_rate(comparison: str) -> Figure | None:
    """Our steps/s in a comparison."""
    if comparison not in (found := measured()):
        return None
    call, path = found[comparison]
    return _both(call.results, comparison, "steps_per_s", source(path.stem, call))[0]


def _ratio(results: Mapping[str, Any], comparison: str, *sources: Source) -> Ratio | None:
    return over(*_both(results, comparison, "steps_per_s", *sources))


def _both(
    results: Mapping[str, Any], comparison: str, key: str, *sources: Source
) -> list[Figure | None]:
    """A figure of both sides, ours first."""
    cases = results.get("cases", {})
    found = []
    for trainer in (OURS, COMPARISONS[comparison].peer):
        runs = cases.get(case_name(comparison, trainer), {}).get("runs", ())
        values = [run["summary"][key] for run in runs if "summary" in run]
        found.append(figure(values, *sources))
    return found
