"""The tables of what single tasks learn, and how fast."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.cases import REWARD, TASKS
from benchmarks.evaluation.evidence import FigureText, Ratio
from benchmarks.evaluation.figures import (
    NOT_MEASURED,
    RATES,
    Figure,
    bounds,
    figure,
    over,
    rate,
    results_of,
    shown,
    sources_of,
    text_of,
)
from benchmarks.evaluation.seed_tables import of_algorithms
from benchmarks.evaluation.writer import Calls, Rows, table, table_of_calls
from benchmarks.outcomes import Curve, seconds_to
from benchmarks.records import calls_by_date

NEARLY = 0.9
"""Of a return, that is reached more surely than all of it."""

MARKS = (
    ("ant", 3000, "20 s", ("reward-ant", "ant 1 x 8192")),
    ("humanoid", 5000, "under 240 s", ("reward-humanoid", "humanoid 1 x 8192")),
)
"""Task, return, what Isaac Gym publishes for it on an A100 (arXiv:2108.10470); file and case."""


@table(
    "marks",
    "task | return: | runs that reached it: | seconds, here: | Isaac Gym, on an A100:",
    *(file for *_, (file, _) in MARKS),
)
def marks() -> Rows:
    """Seconds from the first report of a run alone on its GPU to a return that others publish."""
    for task, mark, published, case in MARKS:
        found, runs = reached(mark, *case), len(times_to(mark, *case))
        share = f"{found.repeats if found else 0} of {runs}"
        yield [task, f"{mark:,}", share, shown(found, ".1f"), published]


def seconds_to_mark(task: str) -> Figure | None:
    """Seconds of training until a task reaches the return that Isaac Gym's authors give."""
    ((mark, case),) = ((mark, case) for name, mark, _, case in MARKS if name == task)
    return reached(mark, *case)


def reached(mark: float, file: str, case: str) -> Figure | None:
    """Seconds of the runs that got there, see `times_to`."""
    times = [seconds for seconds in times_to(mark, file, case) if seconds is not None]
    return figure(times, *sources_of(file))


def times_to(mark: float, file: str, case: str) -> list[float | None]:
    """Of every run that was alone on its GPU; None of one that did not get there."""
    runs = results_of(file).get("cases", {}).get(case, {}).get("runs", ())
    curves = [run["curve"] for run in runs if "curve" in run and "together" not in run]
    return [seconds_to(mark, curve) for curve in curves]


def _gmis(task: str) -> tuple[tuple[str, str], ...]:
    """File and cases of figure 9: in one process, and in four GMIs."""
    return tuple((f"reward-{task}", f"{task} {gmis} x {8192 // gmis}") for gmis in (1, 4))


def _mark(task: str) -> float | None:
    """Nine tenths of what one process reaches."""
    final = rate(*_gmis(task)[0], "final_return")
    return NEARLY * final.median if final else None


def seconds_over_one_process(task: str) -> Ratio | None:
    """Of four GMIs to the same return."""
    if (mark := _mark(task)) is None:
        return None
    one, four = (reached(mark, *case) for case in _gmis(task))
    return over(four, one)


def text_of_reward(task: str) -> FigureText:
    """`seconds_over_one_process`, with how many runs of four GMIs got there, if not all."""
    ratio, mark = text_of(seconds_over_one_process(task)), _mark(task)
    share = "" if mark is None else _if_not_all(mark, *_gmis(task)[1])
    return ratio._replace(text=ratio.text + share)


@table(
    "reward",
    "task | return at the end, one process: | four GMIs: | mark: | seconds to it, one process: | "
    "four GMIs: | ratio:",
    *(f"reward-{task}" for task in REWARD),
)
def reward() -> Rows:
    """The same training in one process and in four GMIs of the GPU."""
    for task in REWARD:
        mark = _mark(task)
        finals = (shown(rate(*case, "final_return"), ",.0f") for case in _gmis(task))
        cells = (_seconds_to(mark, *case) for case in _gmis(task))
        gain = shown(seconds_over_one_process(task))
        yield [f"`{task}`", *finals, shown(mark, ",.0f"), *cells, gain]


def _seconds_to(mark: float | None, file: str, case: str) -> str:
    """With how many runs got there, if not all."""
    if mark is None:
        return NOT_MEASURED
    return shown(reached(mark, file, case), ".1f") + _if_not_all(mark, file, case)


def _if_not_all(mark: float, file: str, case: str) -> str:
    """How many of the runs got there; nothing if all did."""
    times = times_to(mark, file, case)
    did = sum(seconds is not None for seconds in times)
    return f", {did} of {len(times)} runs" if did < len(times) else ""


def _of_algorithms() -> Calls:
    """Of every task the newest call that trained it by several algorithms."""
    calls = calls_by_date("seeds-*-nvidia-*.json")
    return {call.results["task"]: (call, path) for call, path in calls if of_algorithms(call)}


@table_of_calls(
    "returns",
    "task | trained by | million steps: | successes: | return at the end: | after equal steps: | "
    "after equal seconds: | mark: | seeds that reach it: | seconds of training to it:",
    _of_algorithms,
)
def returns(calls: Calls) -> Rows:
    """What algorithms reach beside the first one, whose nine tenths are the mark of a task."""
    for task, (call, _) in sorted(calls.items()):
        rows = call.results["rows"]
        mark = NEARLY * rows[0]["return"][1] if rows and rows[0]["return"] else None
        curves = [curve for row in rows for curve in _curves(row)]
        # What every run has: the least steps, and the least seconds.
        equal_steps = min((curve[-1][0] for curve in curves), default=0)
        equal_s = min((curve[-1][1] - curve[0][1] for curve in curves), default=0.0)
        for row in rows:
            yield _beside(task, row, mark, equal_steps, equal_s)


def _curves(row: Mapping[str, Any]) -> list[Curve]:
    """Of its seeds, also of those that were stopped."""
    return [one["curve"] for one in (*row["each"], *row["cut"]) if one["curve"]]


def _beside(
    task: str, row: Mapping[str, Any], mark: float | None, equal_steps: int, equal_s: float
) -> list[str]:
    """Cells of an algorithm: what its seeds reach, and how many of them the mark, and when.

    Seeds that were stopped count as they were then.
    """
    runs, seeds = [*row["each"], *row["cut"]], row["seeds"] + row["unfinished"]
    curves = _curves(row)
    finals = [one["final_return"] for one in runs if one["final_return"] is not None]
    by_steps = [_last_return(c, lambda steps, _: steps <= equal_steps) for c in curves]
    by_seconds = [_last_return(c, lambda _, seconds: seconds <= equal_s) for c in curves]
    times = [] if mark is None else [seconds_to(mark, curve) for curve in curves]
    reached = [s for s in times if s is not None]
    returns = (figure([r for r in one if r is not None]) for one in (finals, by_steps, by_seconds))
    return [
        *(f"`{task}`", row["row"], bounds([curve[-1][0] / 1e6 for curve in curves], ".0f")),
        *(f"{row['successes']} of {seeds}", *(shown(one, ",.4g") for one in returns)),
        *(shown(mark, ",.4g"), f"{len(reached)} of {seeds}", shown(figure(reached), ".0f")),
    ]


def _last_return(curve: Curve, counts: Callable[[int, float], bool]) -> float | None:
    """The last one whose steps, and seconds from the first line, count."""
    found = [r for steps, at, r in curve if r is not None and counts(steps, at - curve[0][1])]
    return found[-1] if found else None


@table(
    "throughput",
    "task | environments: | simulation: | with inference: | with training:",
    "tasks-warp",
)
def throughput() -> Rows:
    """Steps/s of every task and size."""
    for task in TASKS:
        for envs in (2048, 8192, 32768):
            found = [rate("tasks-warp", f"{task} warp {envs}", key) for key in RATES]
            if all(found):
                yield [f"`{task}`", f"{envs:,}", *(shown(one, ",.0f") for one in found)]
