"""Commands at once on a GPU: `python -m benchmarks.packs NAME ... -- COMMAND`.

The same command as `gmijax pack` runs it: with one at a time, several under MPS, several by turns,
and as many as `auto` takes. Beside the trainings per hour, start-up included, stand the steps per
second while jobs report: the sum over jobs of the mean from their first report to their last, for
jobs of one kind.
Writes `benchmarks/results/packs-<device>.json` after every pack. With `--gpus` repeats run at the
same time, each on a GPU of its own with its part of the cores.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.free_gpus import Part, on_parts
from benchmarks.records import results_file
from benchmarks.runner import deadline, exit_code, in_turn, options, run_command
from benchmarks.steady import rate_of_jobs
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.runs.folder import read_json

_OF_JOB = ("state", "env_steps", "env_steps_per_s", "start_s", "first_update_s", "wall_s")


class Way(NamedTuple):
    """How the commands of a pack share the GPU."""

    at_once: str  # Jobs on the GPU, or `auto`.
    backend: str  # `pack.backend`.
    copies: int

    def __str__(self) -> str:
        of = f" of {self.copies}" if self.at_once != str(self.copies) else ""
        return f"{self.at_once}{of} at once, {self.backend}"


class Benchmark:
    """The packs of one call, in its file after each of them."""

    def __init__(self, given: argparse.Namespace, machine: Machine) -> None:
        self._given, self._machine = given, machine
        self._file = results_file(given, "packs", gpus=1)
        self._deadline_s = deadline(given.deadline_s)

    def run(self, ways: Sequence[Way]) -> bool:
        """Whether there was time for all."""
        given = self._given

        def repeat(number: int, part: Part) -> bool:
            return self._repeat(number, ways, part)

        return all(on_parts(self._machine, given.gpus, range(given.repeats), repeat))

    def _repeat(self, number: int, ways: Sequence[Way], part: Part) -> bool:
        num_rows = 0
        for _, way in in_turn(ways, 1, self._deadline_s):
            row = {"name": self._given.name, "way": str(way), "repeat": number}
            row |= self._pack(way, part)
            self._file.add("rows", row)
            print(json.dumps(row), flush=True)
            num_rows += 1
        return num_rows == len(ways)

    def _pack(self, way: Way, part: Part) -> dict[str, Any]:
        given = self._given
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "pack"
            command = [
                *(*part.prefix, sys.executable, "-m", "gmijax.pack", f"run.dir={root}"),
                *(f"pack.copies={way.copies}", f"pack.jobs_per_gpu={way.at_once}"),
                *(f"pack.backend={way.backend}", *given.keys, "--", *given.command),
            ]
            code = run_command(command, self._deadline_s, part.variables)
            if not (root / "pack.json").exists():
                return {"exit_code": code}
            report = read_json(root / "pack.json")
            jobs = [{key: job[key] for key in _OF_JOB} for job in report["jobs"]]
            return {
                "exit_code": code,
                "copies": way.copies,
                "steps_per_s": rate_of_jobs(jobs) if way.at_once == str(way.copies) else None,
                "trainings_per_hour": report["trainings_per_hour"],
                "wall_s": report["wall_s"],
                "at_once": report["at_once"],
                "jobs": jobs,
                "curves": _curves(report["jobs"]) if given.curves else None,
            }


def _curves(jobs: Sequence[dict[str, Any]]) -> list[list[list[float]]]:
    """Steps and metric of the reports of each job; none of one that did not start."""
    curves = []
    for job in jobs:
        path = Path(job["run_dir"]) / "pack" / "metrics.jsonl"
        found = (
            [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        )
        curves.append([[one["env_steps"], one["metric"]] for one in found if "metric" in one])
    return curves


def main() -> int:
    """Measures what the command line asks for; returns 1 if its time was too short, else 0."""
    given, machine = _options(), detect_machine()
    return 0 if Benchmark(given, machine).run(_ways(given, has_gpu=bool(machine.gpus))) else 1


def _ways(given: argparse.Namespace, *, has_gpu: bool) -> list[Way]:
    mps = "mps" if has_gpu else "auto"
    return [
        *(Way(str(count), mps, count) for count in given.at_once),
        *(Way(str(count), "share", count) for count in given.share),
        *(Way("auto", "auto", count) for count in given.auto),
        *(Way(str(count), mps, copies) for count, copies in given.many),
    ]


def _options() -> argparse.Namespace:
    parser = options("packs", __doc__)
    parser.add_argument("name", help="of the training, in the file")
    parser.add_argument("--at-once", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--share", type=int, nargs="*", default=[4], help="without MPS")
    parser.add_argument("--auto", type=int, nargs="*", default=[], help="copies with auto")
    parser.add_argument(
        "--many", type=_pair, nargs="*", default=[], help="so many at once of more, as 8/16"
    )
    parser.add_argument("--gpus", type=int, default=1, help="for repeats at the same time")
    parser.add_argument("--keys", nargs="*", default=[], help="of gmijax pack, as key=value")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--curves", action="store_true", help="keep the metric of every job")
    parser.add_argument("--deadline-s", type=float)
    at = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    given = parser.parse_args(sys.argv[1:at])
    given.command = sys.argv[at + 1 :]
    if not given.command:
        parser.error("no command: expected -- COMMAND ...")
    return given


def _pair(text: str) -> tuple[int, int]:
    count, copies = map(int, text.split("/"))
    return count, copies


if __name__ == "__main__":
    sys.exit(exit_code(main))
