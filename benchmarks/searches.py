"""What Algorithm 2 finds for tasks: `python -m benchmarks.searches -- search.budget_s=180`.

Searches each task on one GPU with a store of profiles that is empty, and keeps its points, its
answer and its seconds in a call of `benchmarks/results/searches-<device>.json`. What is behind
`--` are overrides of `gmijax search`. With `--gpus` tasks are searched at the same time, each on a
GPU of its own with its part of the cores.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.cases import TASKS
from benchmarks.free_gpus import Part, on_parts
from benchmarks.records import results_file
from benchmarks.runner import deadline, exit_code, options, run_command
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import RunPaths, read_json

_KEPT = ("env", "best", "reason", "complete", "points", "num_profiled", "wall_s")


def main() -> int:
    """Searches what the command line asks for; returns 1 if a search has no answer, else 0."""
    given, machine = _options(), detect_machine()
    file, deadline_s = results_file(given, "searches", gpus=1), deadline(given.deadline_s)

    def run(task: str, part: Part) -> int:
        code, found = _search(task, part, given.overrides, deadline_s)
        file.add("rows", {"task": task, "code": code, **found})
        return code

    codes = on_parts(machine, given.gpus, given.tasks, run)
    print(f"written: {file.path}")
    return int(any(codes))


def _search(
    task: str, part: Part, overrides: list[str], deadline_s: float
) -> tuple[int, dict[str, Any]]:
    with tempfile.TemporaryDirectory() as scratch:
        run = RunPaths(Path(scratch) / "search")
        words = [f"env={task}", f"search.store={scratch}", *overrides, f"run.dir={run.root}"]
        command = [*part.prefix, sys.executable, "-m", "gmijax.search", *words]
        code = run_command(command, deadline_s, part.variables)
        found = read_json(run.search_report) if run.search_report.exists() else {}
    return code, {key: found[key] for key in _KEPT if key in found}


def _options() -> argparse.Namespace:
    parser = options("searches", __doc__)
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS, metavar="TASK")
    parser.add_argument("--gpus", type=int, default=1, help="for tasks at the same time")
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("overrides", nargs="*", help="of gmijax search, behind --")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
