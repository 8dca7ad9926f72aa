"""The tables of what single tasks learn, and how fast."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.cases import TASKS
from benchmarks.evaluation.figures import (
    Figure,
    bounds,
    figure,
    rate,
    results_of,
    shown,
)
from benchmarks.evaluation.writer import Rows, table
from benchmarks.records import RESULTS

RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
MARKS = (
    ("ant", 3000, "20 s", "async-long", "1 GPU, synchronous"),
    ("humanoid", 5000, "under 240 s", "learn-humanoid", "humanoid"),
)
"""Task, return, what Isaac Gym publishes for it on an A100 (arXiv:2108.10470); file and case."""


def _learnt() -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    for path in sorted([*RESULTS.glob("learn-*.json"), *RESULTS.glob("entropy-franka_c*.json")]):
        for name, case in results_of(path.stem)["cases"].items():
            if any("summary" in run for run in case["runs"]):
                yield path.stem, name, case


@table(
    "learning",
    "case | MJX | million steps: | seconds alone on a GPU: | return of every run "
    "| metrics, least to most | file",
    more=lambda: dict.fromkeys(file for file, *_ in _learnt()),
)
def learning() -> Rows:
    """What every task reached over its seeds, and how long that took alone on a GPU."""
    for file, name, case in _learnt():
        runs = [run for run in case["runs"] if "summary" in run]
        steps = bounds([run["summary"]["env_steps"] / 1e6 for run in runs], ".0f")
        alone = [run["summary"]["train_wall_s"] for run in runs if "together" not in run]
        returns = ", ".join(shown(run["summary"]["final_return"], ",.0f") for run in runs)
        impl = runs[0]["summary"].get("impl", "")
        seconds = shown(figure(alone), ".0f")
        yield [name, impl, steps, seconds, returns, ", ".join(_metrics(runs)), f"`{file}`"]


def _metrics(runs: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    for name in runs[0].get("metrics", ()):
        values = [run["metrics"][name] for run in runs]
        yield f"{name.removeprefix('metric/')} {bounds(values, '.3g')}"


@table(
    "marks",
    "task | return: | runs that reached it: | seconds, here: | Isaac Gym, on an A100:",
    *(file for *_, file, _ in MARKS),
)
def marks() -> Rows:
    """Seconds from the first report of a run alone on its GPU to a return that others publish."""
    for task, mark, published, file, case in MARKS:
        found = _times_to(mark, file, case)
        reached = [seconds for seconds in found if seconds is not None]
        share = f"{len(reached)} of {len(found)}"
        yield [task, f"{mark:,}", share, shown(figure(reached), ".1f"), published]


def seconds_to_mark(task: str) -> Figure | None:
    """Seconds of training until a task reaches the return that Isaac Gym's authors give."""
    ((mark, file, case),) = ((mark, *run) for name, mark, _, *run in MARKS if name == task)
    return figure([s for s in _times_to(mark, file, case) if s is not None])


def _times_to(mark: float, file: str, case: str) -> list[float | None]:
    """Of every run that was alone on its GPU; None of one that did not get there."""
    runs = results_of(file).get("cases", {}).get(case, {}).get("runs", ())
    curves = [run["curve"] for run in runs if "curve" in run and "together" not in run]
    return [
        next((s - curve[0][1] for _, s, found in curve if (found or 0.0) >= mark), None)
        for curve in curves
    ]


@table(
    "throughput",
    "task | environments: | MJX | simulation: | with inference: | with training:",
    *("tasks-jax", "tasks-warp"),
)
def throughput() -> Rows:
    """Steps/s of every task, size and implementation."""
    for task in TASKS:
        for envs in (2048, 8192, 32768):
            for impl in ("jax", "warp"):
                name = f"{task} {impl} {envs}"
                cells = [shown(rate(f"tasks-{impl}", name, key), ",.0f") for key in RATES]
                yield [f"`{task}`", f"{envs:,}", impl, *cells]
