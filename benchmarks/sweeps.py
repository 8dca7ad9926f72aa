"""Runs per hour of sweeps: `python -m benchmarks.sweeps`.

The same runs as sweeps with one at a time, several under MPS, several under plain sharing,
several as one program, a mix of tasks, and as many as `auto` takes. A sweep counts from the start
of its first job to the end of its last, start-up included; beside it stand the steps per second
while all slots are busy.
Writes `benchmarks/results/sweeps-<device>.json` after every sweep. A call that is interrupted
or reaches its deadline keeps the finished sweeps; one that would not end in time is not started.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.evaluation.figures import figure, shown
from benchmarks.records import results_file
from benchmarks.runner import deadline, exit_code, in_turn, options, sweep_report
from benchmarks.steady import curve_of, steady_rate
from gmijax.machine.snapshot import detect_machine


class Way(NamedTuple):
    """How the runs of a sweep are started."""

    at_once: str  # Jobs on the GPU, or `auto`.
    how: str  # `plan.backend`, or `vmap`: those that can be are one program.
    tasks: str = ""  # Tasks of a mix, with commas; empty: that of the command line.

    @property
    def is_one_program(self) -> bool:
        """Whether jobs share a program, which depends on how many they are."""
        return self.how == "vmap"

    @property
    def compiling(self) -> Way:
        """A way that compiles the same programs: a job of each task beside the others."""
        each = str(1 + self.tasks.count(","))
        return self if self.is_one_program else Way(each, "auto", self.tasks)

    def __str__(self) -> str:
        return f"{self.at_once} at once, {self.how}{', ' * bool(self.tasks)}{self.tasks}"


def run_sweep(
    way: Way, given: argparse.Namespace, deadline_s: float, cache: Path | None, *more: str
) -> dict[str, Any]:
    """One sweep as a whole command."""
    tasks = way.tasks.split(",") if way.tasks else []
    is_one_each = more and not way.is_one_program
    seeds = 1 if is_one_each else max(1, given.jobs // max(1, len(tasks)))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "sweep"
        started_s = time.monotonic()
        code, report = sweep_report(
            [
                *(*given.overrides, *([f"env={way.tasks}"] if tasks else []), *more),
                *(f"seed=range({seeds})", f"sweep.jobs_per_gpu={way.at_once}"),
                "sweep.pack=vmap" if way.is_one_program else f"plan.backend={way.how}",
                "sweep.gpus=1",
            ],
            folder,
            deadline_s,
            {"JAX_COMPILATION_CACHE_DIR": str(cache or Path(scratch) / "xla")},
        )
        command_s = round(time.monotonic() - started_s, 2)
        curves = [curve for row in report["jobs"] if (curve := curve_of(row))]
    jobs, each = report["jobs"], report["sweep"]["jobs_per_gpu"]
    return {
        "status": report["status"],
        "code": code,
        "jobs_per_gpu": each,
        "command_s": command_s,
        "trainings_per_hour": report["trainings_per_hour"],
        # Never, where runs are too short to overlap.
        "steady_steps_per_s": steady_rate(curves, min(each, len(jobs)))
        if isinstance(each, int)
        else None,
        "first_update_s": [job["first_update_s"] for job in jobs],
        "job_wall_s": [job["wall_s"] for job in jobs],
        "values": [job["value"] for job in jobs],
        "states": [job["state"] for job in jobs],
    }


def main() -> int:
    """Measures what the command line asks for; returns 1 if a sweep failed, else 0."""
    given = _options()
    counts = {
        "auto": given.at_once,
        "share": given.shared if detect_machine().gpus else [],
        "vmap": given.packed,
    }
    ways = [Way(str(n), how, given.mix) for how, found in counts.items() for n in found]
    ways += [Way("auto", "auto", given.mix)] if given.auto else []
    file, deadline_s = results_file(given, "sweeps"), deadline(given.deadline_s)
    with tempfile.TemporaryDirectory() as scratch:
        cache = Path(scratch) / "xla" if given.warm else None
        if cache is not None:
            for way in dict.fromkeys(way.compiling for way in ways):
                run_sweep(way, given, deadline_s, cache, "num_timesteps=1")
        try:
            for repeat, way in in_turn(ways, given.repeats, deadline_s):
                measured = run_sweep(way, given, deadline_s, cache)
                file.add("runs", {"way": str(way), "repeat": repeat, **measured})
        finally:
            runs = file.results.get("runs", [])
            for text in medians(runs):
                print(text)
    return int(any(run["status"] == "failed" for run in runs))


def medians(runs: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What the sweeps that are through made, a line for each way."""
    for way in dict.fromkeys(run["way"] for run in runs):
        done = [run for run in runs if run["way"] == way and run["status"] == "completed"]
        per_hour = shown(figure([run["trainings_per_hour"] for run in done]), ".1f")
        steady = figure([rate for run in done if (rate := run["steady_steps_per_s"])])
        steps = shown(steady, ",.0f")
        yield f"{way}: {per_hour} runs/h, {steps} steps/s while all slots are busy"


def _options() -> argparse.Namespace:
    parser = options("sweeps", __doc__)
    parser.add_argument("overrides", nargs="*", help="of the runs, e.g. env=ant")
    parser.add_argument("--jobs", type=int, default=8, help="runs of a sweep")
    parser.add_argument("--at-once", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--shared", type=int, nargs="*", default=[4], help="without MPS")
    parser.add_argument("--packed", type=int, nargs="*", default=[], help="as one program")
    parser.add_argument("--mix", default="", help="a mix of these tasks, e.g. ant,humanoid")
    parser.add_argument("--auto", action="store_true", help="also sweep.jobs_per_gpu=auto")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument(
        "--warm",
        action="store_true",
        help="with compiled programs from a short training before; otherwise each sweep compiles",
    )
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
