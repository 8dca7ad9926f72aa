"""Figures out of files of results: looked up by path, medians over repeats, ratios in one call."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from benchmarks.evaluation.evidence import Evidence, FigureText, Ratio, Source, source, together
from benchmarks.records import RESULTS, Call, read_calls
from gmijax.errors import ConfigError

NOT_MEASURED = "not measured"
RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
TRAINING = RATES[-1]
WHOLE_RUN = "env_steps_per_s"


class Figure(NamedTuple):
    """A median over repeats.

    Attributes:
      median: of the repeats.
      low: the smallest of them.
      high: the largest.
      repeats: how many there are.
      sources: the calls that they are from.
    """

    median: float
    low: float
    high: float
    repeats: int
    sources: frozenset[Source] = frozenset()

    @property
    def evidence(self) -> Evidence:
        """The repeats and the calls behind it."""
        return Evidence(self.repeats, self.sources)

    def shown(self, form: str = ",.0f") -> str:
        """The median; with several repeats also from where to where they go."""
        text = format(self.median, form)
        if self.repeats == 1:
            return text
        return f"{text} ({self.low:{form}} to {self.high:{form}}, n={self.repeats})"


def figure(values: Sequence[float], *sources: Source) -> Figure | None:
    """The median of what was measured, None of nothing."""
    if not values:
        return None
    found = statistics.median(values), min(values), max(values), len(values)
    return Figure(*found, frozenset(sources))


def call_of(file: str) -> Call | None:
    """The call of `<file>.json` that counts: the newest of those that measured most.

    So a later call of a few cases does not hide the others. None without a file.
    """
    path = RESULTS / f"{file}.json"
    if not path.exists():
        return None
    calls = list(enumerate(read_calls(path)))
    return max(calls, key=lambda one: (_count(one[1].results), one[0]))[1]


def measured(files: Iterable[str]) -> list[str]:
    """Those that there are, each once."""
    return [file for file in dict.fromkeys(files) if (RESULTS / f"{file}.json").exists()]


def sources_of(file: str) -> list[Source]:
    """That call; nothing without a file."""
    call = call_of(file)
    return [source(file, call)] if call else []


def results_of(file: str) -> Mapping[str, Any]:
    """What that call measured; nothing without a file."""
    call = call_of(file)
    return call.results if call else {}


def rate(file: str, case: str, key: str = TRAINING) -> Figure | None:
    """A figure of the summaries of a case of `<file>.json`; `key` is a path in them."""
    return figure([*_at(results_of(file), f"{case}/{key}")], *sources_of(file))


def summaries(file: str, case: str) -> list[Mapping[str, Any]]:
    """Of the runs of a case that succeeded."""
    runs = results_of(file).get("cases", {}).get(case, {}).get("runs", ())
    return [run["summary"] for run in runs if "summary" in run]


def busy_sms(file: str, case: str) -> Figure | None:
    """Part of the SMs that were busy in the runs of a case, 0 to 1."""
    runs = results_of(file).get("cases", {}).get(case, {}).get("runs", ())
    values = [run["busy_sms"] for run in runs if run.get("busy_sms") is not None]
    return figure(values, *sources_of(file))


def ratio(file: str, case: str, base: str, key: str = TRAINING) -> Ratio | None:
    """Median of `case` over that of `base`: of one call, so of one machine."""
    return over(rate(file, case, key), rate(file, base, key))


def over(one: Figure | None, base: Figure | None) -> Ratio | None:
    """Median over median, where both were measured."""
    if not one or not base:
        return None
    evidence = Evidence(min(one.repeats, base.repeats), one.sources | base.sources)
    return Ratio(one.median / base.median, evidence)


def shown(value: Figure | float | None, form: str = ".2f") -> str:
    """A cell of a table."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return NOT_MEASURED
    return value.shown(form) if isinstance(value, Figure) else format(value, form)


def bounds(values: Sequence[float | None], form: str = ".2f") -> str:
    """`0.83 to 0.96`, of those that were measured."""
    found = [value for value in values if value is not None]
    if not found:
        return NOT_MEASURED
    low, high = format(min(found), form), format(max(found), form)
    return low if low == high else f"{low} to {high}"


def text_of(value: Figure | Ratio | None, form: str = ".2f") -> FigureText:
    """The text of a figure as `shown` writes it, with its evidence."""
    return FigureText(shown(value, form), value.evidence if value is not None else None)


def text_of_range(values: Sequence[Figure | Ratio | None], form: str = ".2f") -> FigureText:
    """The text of several figures as `bounds` writes it, with the evidence of all of them."""
    found = [value for value in values if value is not None]
    medians = [value.median if isinstance(value, Figure) else value for value in found]
    return FigureText(bounds(medians, form), together(value.evidence for value in found))


def joined_texts(between: str, parts: Iterable[FigureText]) -> FigureText:
    """Several texts with `between` from one to the next; `not measured` once if none was."""
    found = list(parts)
    evidence = together(one.evidence for one in found if one.evidence)
    if evidence is None:
        return FigureText(NOT_MEASURED, None)
    return FigureText(between.join(one.text for one in found), evidence)


def _count(results: Mapping[str, Any]) -> int:
    """How much was measured: cases with runs, or rows of whatever the suite has."""
    lists = [results.get(key, ()) for key in ("cases", "rows", "points", "runs", "tasks")]
    return len(list(repeats_of(results))) or max(map(len, lists))


def repeats_of(results: Mapping[str, Any]) -> Iterator[int]:
    """How often each case was measured, of those that were."""
    cases = results.get("cases", ())
    for case in cases.values() if isinstance(cases, Mapping) else cases:
        runs = case.get("runs", ())
        if isinstance(runs, Mapping):  # Of serving, by template.
            yield max(map(len, runs.values()))
        elif done := sum("summary" in run for run in runs):
            yield done


def look_up(reference: str) -> float:
    """The value of `FILE.json#PATH`, or of `FILE.json#PATH over PATH`.

    A path has keys divided by `/`; `*` is every item of a list, whose median counts; a number is
    one item, and so is a name that the item has as `name`. `cases/` and `runs/*/summary/` may be
    left out. The newest call of the file that has all of the reference is taken.

    Raises:
      ConfigError: no call has it.
    """
    medians = [statistics.median(found) for found in look_up_all(reference)[1]]
    return medians[0] / medians[1] if len(medians) > 1 else medians[0]


def look_up_all(reference: str) -> tuple[Call, list[list[float]]]:
    """The call that `look_up` takes, and of each of its paths the values whose median it takes."""
    file, _, rest = reference.partition("#")
    for call in reversed(read_calls(RESULTS / file)):
        values = [list(_at(call.results, path.strip())) for path in rest.split(" over ")]
        if all(values):
            return call, values
    raise ConfigError(f"{file} has no {rest}")


def ratio_at(reference: str) -> Ratio | None:
    """The value of `FILE.json#PATH over PATH`; None if no call has it."""
    try:
        call, values = look_up_all(reference)
    except ConfigError:
        return None
    made_by = source(reference.partition(".json")[0], call)
    one, base = (figure(found, made_by) for found in values)
    return over(one, base)


def _at(node: Any, path: str) -> Iterator[float]:
    if not path:
        if isinstance(node, int | float):
            yield node
    elif isinstance(node, Mapping):
        yield from _in_mapping(node, path)
    elif isinstance(node, list):
        first, _, rest = path.partition("/")
        for number, item in enumerate(node):
            name = item.get("name") if isinstance(item, Mapping) else None
            if first in ("*", str(number)):
                yield from _at(item, rest)
            elif name is not None and _is_first(name, path):
                yield from _at(item, path[len(name) + 1 :])


def _in_mapping(node: Mapping[str, Any], path: str) -> Iterator[float]:
    # A key may have a slash in it: the longest that fits.
    if fit := [key for key in node if _is_first(key, path)]:
        key = max(fit, key=len)
        yield from _at(node[key], path[len(key) + 1 :])
    elif "cases" in node:
        yield from _at(node["cases"], path)
    elif "runs" in node:
        for run in node["runs"]:
            yield from _at(run.get("summary"), path)


def _is_first(key: str, path: str) -> bool:
    return path == key or path.startswith(f"{key}/")
