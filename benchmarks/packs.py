"""Commands at once on a GPU: `python -m benchmarks.packs NAME ... -- COMMAND`.

The same command as `gmijax pack` runs it: with one at a time, several under MPS, several by turns,
and as many as `auto` takes. Beside the trainings per hour, start-up included, stand the steps per
second while jobs report: the sum over jobs of the mean from their first report to their last.
Writes `benchmarks/results/packs-<device>.json` after every pack.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.command import STOP_S, run_command
from benchmarks.records import RESULTS, ResultsFile, file_name
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import read_json

_OF_JOB = ("state", "env_steps", "env_steps_per_s", "start_s", "first_update_s", "wall_s")


class Way(NamedTuple):
    """How the commands of a pack share the GPU."""

    at_once: str  # Jobs on the GPU, or `auto`.
    backend: str  # `pack.backend`.
    copies: int

    def __str__(self) -> str:
        return f"{self.at_once} at once, {self.backend}"


def main() -> int:
    """See the module."""
    given = _options()
    machine = detect_machine()
    device = machine.gpus[0].name if machine.gpus else "cpu"
    settings = {**vars(given), "command": list(given.command)}
    file = ResultsFile(given.out / file_name("packs", device), "packs", settings)
    end_s = time.monotonic() + (given.deadline_s or math.inf)
    mps = "mps" if machine.gpus else "auto"
    ways = [
        *(Way(str(count), mps, count) for count in given.at_once),
        *(Way(str(count), "share", count) for count in given.share),
        *(Way("auto", "auto", count) for count in given.auto),
    ]
    for repeat in range(given.repeats):
        for way in ways:
            if time.monotonic() > end_s - STOP_S:
                return 1
            row = {
                "name": given.name,
                "way": str(way),
                "repeat": repeat,
                **_run(given, way, end_s),
            }
            with file.changing() as results:
                results["rows"] = [*results.get("rows", []), row]
            sys.stdout.write(f"{json.dumps(row)}\n")
            sys.stdout.flush()
    return 0


def _run(given: argparse.Namespace, way: Way, end_s: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "pack"
        keys = (
            f"run.dir={root}",
            f"pack.copies={way.copies}",
            f"pack.jobs_per_gpu={way.at_once}",
            f"pack.backend={way.backend}",
            *given.keys,
        )
        line = [sys.executable, "-m", "gmijax.pack", *keys, "--", *given.command]
        code = run_command(line, end_s)
        if not (root / "pack.json").exists():
            return {"exit_code": code}
        report = read_json(root / "pack.json")
        rates = [job["env_steps_per_s"] or 0.0 for job in report["jobs"]]
        return {
            "exit_code": code,
            "copies": way.copies,
            "steps_per_s": sum(rates) if way.at_once == str(way.copies) else None,
            "trainings_per_hour": report["trainings_per_hour"],
            "wall_s": report["wall_s"],
            "at_once": report["at_once"],
            "jobs": [{key: job[key] for key in _OF_JOB} for job in report["jobs"]],
            "curves": _curves(root, report["jobs"]) if given.curves else None,
        }


def _curves(root: Path, jobs: Sequence[dict[str, Any]]) -> list[list[list[float]]]:
    """Steps and metric of the reports of each job."""
    curves = []
    for job in jobs:
        lines = (Path(job["run_dir"]) / "metrics.jsonl").read_text().splitlines()
        found = [json.loads(line) for line in lines]
        curves.append([[one["env_steps"], one["metric"]] for one in found if "metric" in one])
    return curves


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", help="of the training, in the file")
    parser.add_argument("--at-once", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--share", type=int, nargs="*", default=[4], help="without MPS")
    parser.add_argument("--auto", type=int, nargs="*", default=[], help="copies with auto")
    parser.add_argument("--keys", nargs="*", default=[], help="of gmijax pack, as key=value")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--curves", action="store_true", help="keep the metric of every job")
    parser.add_argument("--deadline-s", type=float)
    parser.add_argument("--out", type=Path, default=RESULTS)
    at = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    given = parser.parse_args(sys.argv[1:at])
    given.command = sys.argv[at + 1 :]
    if not given.command:
        parser.error("no command: expected -- COMMAND ...")
    return given


if __name__ == "__main__":
    sys.exit(main())
