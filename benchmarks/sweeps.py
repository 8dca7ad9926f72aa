"""Trainings per hour of sweeps: `python -m benchmarks.sweeps`.

The same trainings as whole commands, start and compiling included: one after another, several at
a time under MPS, and several under plain sharing. Each command has a cache of compiled programs of
its own, empty at first, unless `--warm`. Adds a call to
`benchmarks/results/sweeps-<device>.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.records import RESULTS, ResultsFile, device_name, file_name


def main() -> int:
    """Measures what the command line asks for; returns 1 if a sweep failed, else 0."""
    arguments = _arguments()
    path = arguments.out / file_name("sweeps", device_name())
    book = ResultsFile(path, "sweeps", vars(arguments))
    ways = [(n, "auto") for n in arguments.at_once] + [(n, "share") for n in arguments.shared]
    runs: list[dict[str, Any]] = []
    for repeat in range(arguments.repeats):
        for at_once, backend in ways:
            runs.append(_run(arguments, at_once, backend, repeat))
            sys.stdout.write(f"{json.dumps(runs[-1])}\n")
            sys.stdout.flush()
            with book.changing() as results:
                results["runs"] = runs
    for at_once, backend in ways:
        rates = [
            run["trainings_per_hour"]
            for run in runs
            if (run["at_once"], run["backend"]) == (at_once, backend) and run["code"] == 0
        ]
        if rates:
            median = statistics.median(rates)
            sys.stdout.write(f"{at_once} at once, {backend}: {median:.1f} trainings/h\n")
    return int(any(run["code"] for run in runs))


def _run(arguments: argparse.Namespace, at_once: int, backend: str, repeat: int) -> dict[str, Any]:
    """One sweep as a whole command."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "sweep"
        command = [sys.executable, "-m", "gmijax.sweep", *arguments.overrides]
        command += [f"seed=range({arguments.jobs})", f"sweep.jobs_per_gpu={at_once}"]
        command += [f"plan.backend={backend}", "sweep.gpus=1", f"run.dir={folder}"]
        cache = {} if arguments.warm else {"JAX_COMPILATION_CACHE_DIR": f"{scratch}/xla"}
        started_s = time.monotonic()
        code = subprocess.run(command, env={**os.environ, **cache}, check=False).returncode
        wall_s = time.monotonic() - started_s
        report = json.loads((folder / "sweep.json").read_text())
        jobs = report["jobs"]
    return {
        "way": f"{at_once} at once, {backend}",
        "at_once": at_once,
        "backend": backend,
        "repeat": repeat,
        "code": code,
        "wall_s": round(wall_s, 2),
        "trainings_per_hour": 3600 * arguments.jobs / wall_s,
        "job_wall_s": [job["wall_s"] for job in jobs],
        "values": [job["value"] for job in jobs],
        "states": [job["state"] for job in jobs],
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="of the trainings, e.g. env=ant")
    parser.add_argument("--jobs", type=int, default=8, help="seeds to train")
    parser.add_argument("--at-once", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--shared", type=int, nargs="*", default=[4], help="without MPS")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--warm", action="store_true", help="with what is compiled already")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
