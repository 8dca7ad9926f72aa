"""How many seeds of a setting succeed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.evaluation.figures import NOT_MEASURED, shown
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.records import Call, calls_by_date

PATTERN = "seeds-*-nvidia-*.json"
PLAYGROUND = "playground-"


def of_algorithms(call: Call) -> bool:
    """Whether its rows are of different algorithms, and not settings of one."""
    overrides = (one for row in call.results["rows"] for one in row["overrides"])
    return any(one.startswith("algo=") for one in overrides)


def _calls(*, of_playground: bool) -> list[tuple[Call, Path]]:
    """With Playground's tasks or with the others, by task, those of a task in order of date."""
    calls = [one for one in calls_by_date(PATTERN) if not of_algorithms(one[0])]
    found = sorted(calls, key=lambda one: one[0].results["task"])
    return [one for one in found if one[0].results["task"].startswith(PLAYGROUND) == of_playground]


def _numbered() -> Calls:
    """Of all tasks but Playground's, by task and number."""
    number, found = Counter[str](), {}
    for call, path in _calls(of_playground=False):
        task = call.results["task"]
        number[task] += 1
        found[task, number[task]] = call, path
    return found


@table_of_calls(
    "seeds",
    "task | call: | steps: | precision | changed | successes: | interval of 95 %: | p: | "
    "reward of a step in the end:",
    _numbered,
    note=lambda key: f"call {key[1]}",
)
def seeds(calls: Calls) -> Rows:
    """Successes of every setting whose seeds all ran, by task and call; calls in order of date."""
    for (task, number), (call, _) in calls.items():
        assert call.settings is not None
        changed = dict(override.split("=", 1) for override in call.settings["overrides"])
        steps = f"{float(changed['num_timesteps']) / 1e6:.0f}M"
        precision = changed.get("algo.precision", "float32")
        for row in _finished(call):
            yield [f"`{task}`", str(number), steps, precision, *_cells(row)]


def _finished_on_playground() -> Calls:
    """Of Playground's tasks every call with a row whose seeds all ran, by task and date."""
    calls = [one for one in _calls(of_playground=True) if _finished(one[0])]
    return {(one[0].results["task"].removeprefix(PLAYGROUND), one[0].date): one for one in calls}


@table_of_calls(
    "playground-seeds",
    "task | commit | changed | successes: | return of every run: | without noise:",
    _finished_on_playground,
)
def playground_seeds(calls: Calls) -> Rows:
    """What tasks of Playground reach with Playground's settings, over seeds, as they train.

    Returns are those of the latest episodes of training, and of the last evaluation.
    """
    for (task, _), (call, _) in calls.items():
        for row in _finished(call):
            of_training = [run["final_return"] for run in row["each"]]
            evaluated = [run["at_end"].get("eval/last") for run in row["each"]]
            successes = f"{row['successes']} of {row['seeds']}"
            cells = (call.commit or "", _changed(row), successes, _each(of_training))
            yield [task, *cells, _each(evaluated)]


def _each(returns: Sequence[float | None]) -> str:
    if all(one is None for one in returns):
        return NOT_MEASURED
    return ", ".join(shown(one, ".0f") for one in returns)


def _by_brax() -> Calls:
    """Of every task of Playground the newest call that trained it by Brax's PPO."""
    calls = calls_by_date("brax-returns-nvidia-*.json")
    return {task: (call, path) for call, path in calls for task in call.results}


@table_of_calls("brax-returns", "task | million steps: | return of every run:", _by_brax)
def brax_returns(calls: Calls) -> Rows:
    """What Brax's PPO reaches on tasks of Playground, in the last report of every run."""
    for task, (call, _) in calls.items():
        steps, returns = [], []
        for run in call.results[task]:
            at, end = run["returns"][-1] if run["returns"] else (0, None)
            steps.append(f"{at / 1e6:.0f}")
            returns.append(shown(end, ".0f") + (" (failed)" if "failed" in run else ""))
        yield [task, ", ".join(steps), ", ".join(returns)]


def _finished(call: Call) -> list[Mapping[str, Any]]:
    """The rows whose seeds all ran."""
    return [row for row in call.results["rows"] if not row["unfinished"]]


def _cells(row: Mapping[str, Any]) -> list[str]:
    low, high = row["wilson"]
    least, median, most = row["final"]
    return [
        *(_changed(row), f"{row['successes']} of {row['seeds']}"),
        f"{low:.0%} to {high:.0%}",
        shown(row["p_successes"], ".2g") if "p_successes" in row else "",
        f"{median:.3g} ({least:.3g} to {most:.3g})",
    ]


def _changed(row: Mapping[str, Any]) -> str:
    return ", ".join(f"`{override}`" for override in row["overrides"]) or "nothing"
