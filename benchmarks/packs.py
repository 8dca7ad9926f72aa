"""Commands at once on a GPU: `python -m benchmarks.packs NAME ... -- COMMAND`.

The same command as `gmijax pack` runs it: with one at a time, several under MPS, several by turns,
and as many as `auto` takes. Beside the trainings per hour, start-up included, stand the steps per
second while jobs report: the sum over jobs of the mean from their first report to their last.
Writes `benchmarks/results/packs-<device>.json` after every pack. With `--gpus` repeats run at the
same time, each on a GPU of its own with its part of the cores.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
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
        of = f" of {self.copies}" if self.at_once != str(self.copies) else ""
        return f"{self.at_once}{of} at once, {self.backend}"


class Site(NamedTuple):
    """Where the packs of a repeat run."""

    prefix: tuple[str, ...]  # Words before the command, which keep it to some cores.
    variables: Mapping[str, str]


def main() -> int:
    """See the module."""
    given = _options()
    machine = detect_machine()
    gpus = machine.gpus[: given.gpus]
    device = machine.gpus[0].name if gpus else "cpu"
    settings = {**vars(given), "command": list(given.command)}
    # Each row is of one GPU, however many work at the same time.
    path, of_one = given.out / file_name("packs", device), f"1 x {device}" if gpus else None
    file = ResultsFile(path, "packs", settings, device=of_one)
    ways = _ways(given, "mps" if gpus else "auto")
    free: Queue[Site] = Queue()
    for site in _sites(machine.cpu_cores, [gpu.index for gpu in gpus]):
        free.put(site)
    end_s = time.monotonic() + (given.deadline_s or math.inf)

    def repeat(number: int) -> bool:
        site = free.get()
        try:
            return all(_measure(given, way, number, site, file, end_s) for way in ways)
        finally:
            free.put(site)

    with ThreadPoolExecutor(free.qsize()) as pool:
        return 0 if all([*pool.map(repeat, range(given.repeats))]) else 1


def _ways(given: argparse.Namespace, mps: str) -> list[Way]:
    return [
        *(Way(str(count), mps, count) for count in given.at_once),
        *(Way(str(count), "share", count) for count in given.share),
        *(Way("auto", "auto", count) for count in given.auto),
        *(Way(str(count), mps, copies) for count, copies in given.many),
    ]


def _sites(cpus: Sequence[int], gpus: Sequence[int]) -> list[Site]:
    """A GPU each with its part of the cores; all of the machine without several."""
    if len(gpus) < 2:
        return [Site((), {})]
    each = len(cpus) // len(gpus)
    return [
        Site(
            ("taskset", "--cpu-list", ",".join(map(str, cpus[at * each : (at + 1) * each]))),
            {"CUDA_VISIBLE_DEVICES": str(gpu), "CUDA_DEVICE_ORDER": "PCI_BUS_ID"},
        )
        for at, gpu in enumerate(gpus)
    ]


def _measure(
    given: argparse.Namespace, way: Way, repeat: int, site: Site, file: ResultsFile, end_s: float
) -> bool:
    """Adds a row to the file; False where no time was left for it."""
    if time.monotonic() > end_s - STOP_S:
        return False
    found = _run(given, way, site, end_s)
    row = {"name": given.name, "way": str(way), "repeat": repeat, **found}
    with file.changing() as results:
        results["rows"] = [*results.get("rows", []), row]
    sys.stdout.write(f"{json.dumps(row)}\n")
    sys.stdout.flush()
    return True


def _run(given: argparse.Namespace, way: Way, site: Site, end_s: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "pack"
        keys = (
            f"run.dir={root}",
            f"pack.copies={way.copies}",
            f"pack.jobs_per_gpu={way.at_once}",
            f"pack.backend={way.backend}",
            *given.keys,
        )
        line = [*site.prefix, sys.executable, "-m", "gmijax.pack", *keys, "--", *given.command]
        code = run_command(line, end_s, site.variables)
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
        lines = (Path(job["run_dir"]) / "pack" / "metrics.jsonl").read_text().splitlines()
        found = [json.loads(line) for line in lines]
        curves.append([[one["env_steps"], one["metric"]] for one in found if "metric" in one])
    return curves


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
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
    parser.add_argument("--out", type=Path, default=RESULTS)
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
    sys.exit(main())
