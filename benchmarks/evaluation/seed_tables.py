"""How many seeds of a setting succeed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.cases import SUITES
from benchmarks.evaluation.figures import figure, rate, shown, summaries
from benchmarks.evaluation.writer import Rows, lines, link, markdown, origin, table
from benchmarks.records import RESULTS, Call, calls_by_date

PATTERN = "seeds-*-nvidia-*.json"
PLAYGROUND = "playground-"
HEAD = (
    "task | call: | steps: | precision | changed | successes: | interval of 95 %: | p: | "
    "reward of a step in the end:"
)


@lines("seeds")
def seeds() -> list[str]:
    """Successes of every setting whose seeds all ran, by task and call; calls in order of date."""
    rows, calls, number = [], [], Counter[str]()
    for call, path in _calls(of_playground=False):
        task = call.results["task"]
        number[task] += 1
        assert call.settings is not None
        common = _common(call.settings["overrides"])
        rows += [
            [f"`{task}`", str(number[task]), *common, *_cells(row)] for row in _finished(call)
        ]
        calls.append(f"- {link(path.name)}, call {number[task]}: {origin(call)}")
    return [*markdown(HEAD, rows), "", *calls]


@lines("playground-seeds")
def playground_seeds() -> list[str]:
    """What tasks of Playground reach with Playground's settings, over seeds, as they train.

    Of the newest call of a task whose seeds all ran.
    """
    newest = {
        call.results["task"].removeprefix(PLAYGROUND): (call, path)
        for call, path in _calls(of_playground=True)
        if _finished(call)
    }
    rows = [
        [task, _changed(row), f"{row['successes']} of {row['seeds']}", *_returns(row["each"])]
        for task, (call, _) in newest.items()
        for row in _finished(call)
    ]
    head = "task | changed | successes: | return of every run: | without noise:"
    files = [f"- {link(path.name)}: {origin(call)}" for call, path in newest.values()]
    return [*markdown(head, rows), "", *files]


def _returns(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of the latest episodes of training, and of the last evaluation, in order of the seeds."""
    of_training = [run["final_return"] for run in runs]
    evaluated = [run["at_end"].get("eval/last") for run in runs]
    return [", ".join(shown(one, ".0f") for one in ends) for ends in (of_training, evaluated)]


@lines("brax-returns")
def brax_returns() -> list[str]:
    """What Brax's PPO reaches on tasks of Playground, in every run of a task's newest call."""
    newest = {
        task: (runs, f"- {link(path.name)}: {origin(call)}")
        for call, path in calls_by_date(RESULTS, "brax-returns-nvidia-*.json")
        for task, runs in call.results.items()
    }
    rows = [[task, *map(", ".join, _ends(runs))] for task, (runs, _) in newest.items()]
    head = "task | million steps: | return of every run:"
    return [*markdown(head, rows), "", *dict.fromkeys(made for _, made in newest.values())]


def _ends(runs: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Million steps and returns in the last report of every run, and which of them failed."""
    steps, returns = [], []
    for run in runs:
        at, end = run["returns"][-1] if run["returns"] else (0, None)
        steps.append(f"{at / 1e6:.0f}")
        returns.append(shown(end, ".0f") + (" (failed)" if "failed" in run else ""))
    return steps, returns


def _calls(*, of_playground: bool) -> list[tuple[Call, Path]]:
    """With Playground's tasks or with the others, by task, those of a task in order of date."""
    found = sorted(calls_by_date(RESULTS, PATTERN), key=lambda one: one[0].results["task"])
    return [one for one in found if one[0].results["task"].startswith(PLAYGROUND) == of_playground]


def _finished(call: Call) -> list[Mapping[str, Any]]:
    """The rows whose seeds all ran."""
    return [row for row in call.results["rows"] if not row["unfinished"]]


def _common(overrides: Sequence[str]) -> list[str]:
    """How long all runs of a call were, and in what."""
    changed = dict(override.split("=", 1) for override in overrides)
    steps = float(changed["num_timesteps"]) / 1e6
    return [f"{steps:.0f}M", changed.get("algo.precision", "float32")]


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


@table(
    "playground",
    "task | million steps: | steps/s: | seconds of training: | return at the end:",
    "playground",
)
def playground() -> Rows:
    """What tasks of Playground reach with its own settings, in evaluations without noise."""
    for case in SUITES["playground"]:
        found = summaries("playground", case.name)
        steps = shown(figure([one["env_steps"] / 1e6 for one in found]), ",.0f")
        seconds = shown(rate("playground", case.name, "train_wall_s"), ",.0f")
        last = figure([one["eval"]["last"]["return"] for one in found])
        rates = shown(rate("playground", case.name), ",.0f")
        yield [case.name, steps, rates, seconds, shown(last, ",.4g")]
