"""Trainings per hour of sweeps: `python -m benchmarks.sweeps`.

The same trainings as whole commands, start and compiling included: one after another, several at
a time under MPS, and several under plain sharing. Each command has a cache of compiled programs of
its own, empty at first, unless `--warm`. Adds its runs to
`benchmarks/results/sweeps-<device>.json`, with commit, date and settings.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.run import RESULTS
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import write_json
from gmijax.version import versions_of

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "warp-lang")


def main() -> int:
    """Measures what the command line asks for; returns 1 if a sweep failed, else 0."""
    arguments = _arguments()
    machine = detect_machine()
    device = machine.gpus[0].name if machine.gpus else "cpu"
    path = arguments.out / f"sweeps-{device.replace(' ', '-').lower()}.json"
    ways = [(n, "auto") for n in arguments.at_once] + [(n, "share") for n in arguments.shared]
    runs: list[dict[str, Any]] = []
    for repeat in range(arguments.repeats):
        for at_once, backend in ways:
            runs.append(_run(arguments, at_once, backend, repeat))
            sys.stdout.write(f"{json.dumps(runs[-1])}\n")
            sys.stdout.flush()
            _add(path, arguments, device, machine.driver_version, runs)
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


def _add(
    path: Path,
    arguments: argparse.Namespace,
    device: str,
    driver: str | None,
    runs: list[dict[str, Any]],
) -> None:
    """Puts this call beside the earlier ones of the file."""
    calls = json.loads(path.read_text())["calls"] if path.exists() else []
    started = runs[0]["wall_s"]
    own = {
        "commit": _commit(),
        "date": datetime.date.today().isoformat(),
        "device": device,
        "driver": driver,
        "host": f"{os.cpu_count()} cores, {platform.platform()}",
        "versions": versions_of(PACKAGES),
        "overrides": arguments.overrides,
        "jobs": arguments.jobs,
        "is_warm": arguments.warm,
        "first_wall_s": started,
        "runs": runs,
    }
    rest = [call for call in calls if call["first_wall_s"] != started]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"suite": "sweeps", "calls": [*rest, own]})


def _commit() -> str:
    """The commit of the checkout, with a plus where files differ from it."""
    said = [
        subprocess.run(["git", *words], capture_output=True, text=True, check=False).stdout.strip()
        for words in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "gmijax"))
    ]
    return f"{said[0]}{'+' if said[1] else ''}" or "unknown"


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
