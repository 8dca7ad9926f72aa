r"""How surely a task is learnt: `python -m benchmarks.seeds env=ball_balance --seeds 20`.

Every row is a setting, trained with the same seeds as one sweep; the first row is the baseline.

    python -m benchmarks.seeds env=ball_balance num_envs=4096 num_timesteps=10e6 \
        --row baseline --row 'no value clip: algo.clip_value_loss=false'

What counts as success is in `benchmarks/outcomes.py`. After every row
`benchmarks/results/seeds-<task>-<device>.json` is written: successes with Wilson's interval,
quartiles over seeds, and p against the baseline. At the deadline the sweep that runs is stopped;
its runs that are through are kept.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gmijax
from benchmarks.command import run_command
from benchmarks.outcomes import Outcome, against, outcome_of, summary
from benchmarks.played import FILE
from benchmarks.records import RESULTS, ResultsFile, device_name, file_name
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics


class Row(NamedTuple):
    """A setting: its name, and what it changes."""

    name: str
    overrides: Sequence[str]

    @property
    def folder(self) -> str:
        """Its name, as a command line takes it: a comma would be a list of folders."""
        return re.sub(r"[^A-Za-z0-9_.-]+", "-", self.name)


def row_of(text: str) -> Row:
    """Of `NAME` or `NAME: OVERRIDE ...`."""
    name, _, overrides = text.partition(":")
    return Row(name.strip(), tuple(shlex.split(overrides)))


class Benchmark:
    """The rows of one call, in its file after each of them."""

    def __init__(self, arguments: argparse.Namespace, task: str) -> None:
        self._arguments, self._task = arguments, task
        self._deadline_s = time.monotonic() + (arguments.deadline_s or math.inf)
        path = arguments.out / file_name(f"seeds-{task}", device_name())
        self.file = ResultsFile(path, "seeds", vars(arguments))
        self.rows: list[dict[str, Any]] = []
        self._baseline: Sequence[Outcome] = ()

    def analyse(self, folder: Path) -> None:
        """Adds a sweep that is there."""
        self._add(folder.name, folder, {"folder": str(folder)})

    def run(self, rows: Sequence[Row]) -> None:
        """Every row that there is time for; a row is expected to take as long as one before."""
        longest_s = 0.0
        for row in rows:
            if time.monotonic() + longest_s > self._deadline_s:
                break
            with tempfile.TemporaryDirectory() as scratch:
                folder = (self._arguments.runs or Path(scratch)) / row.folder
                longest_s = max(longest_s, self._sweep(row, folder))

    def _sweep(self, row: Row, folder: Path) -> float:
        """Trains a row and writes it down, what is through too if it is interrupted; seconds."""
        started_s, code, own = time.monotonic(), 130, {}
        if self._arguments.play:
            (folder / FILE).unlink(missing_ok=True)  # Of an earlier call.
        try:
            code = run_command(self._command(row, folder), self._deadline_s)
            if self._arguments.play and code in (0, 1):  # 1: a job failed; the others are there.
                own["play_code"] = run_command(self._play(folder), self._deadline_s)
        finally:
            seconds = round(time.monotonic() - started_s, 2)
            if (folder / "sweep.json").exists():
                own |= {"overrides": row.overrides, "code": code, "command_s": seconds}
                self._add(row.name, folder, own)
                with self.file.changing() as results:
                    results.update(task=self._task, rows=self.rows)
        if not (folder / "sweep.json").exists():
            raise SystemExit(f"row {row.name}: no result of its sweep (exit code {code})")
        return seconds

    def _command(self, row: Row, folder: Path) -> list[str]:
        arguments = self._arguments
        return [
            *(sys.executable, "-m", "gmijax.sweep", "run.measure_throughput=false"),
            *(*arguments.overrides, *row.overrides, f"seed=range({arguments.seeds})"),
            *(f"sweep.jobs_per_gpu={arguments.at_once}", f"sweep.pack={arguments.pack}"),
            f"run.dir={folder}",
        ]

    def _play(self, folder: Path) -> list[str]:
        episodes = ("--episodes", str(self._arguments.play))
        return [sys.executable, "-m", "benchmarks.played", str(folder), *episodes]

    def _add(self, name: str, folder: Path, own: Mapping[str, Any]) -> None:
        report = read_json(folder / "sweep.json")
        outcomes, unfinished = outcomes_of(self._task, folder, report)
        row = {
            "row": name,
            **own,
            "status": report["status"],
            "trainings_per_hour": report["trainings_per_hour"],
            "unfinished": unfinished,
            **summary(outcomes),
        }
        if self.rows:
            row |= against(outcomes, self._baseline)
        else:
            self._baseline = outcomes
        self.rows.append({**row, "each": [one._asdict() for one in outcomes]})
        sys.stdout.write(f"{told(row)}\n")
        sys.stdout.flush()


def outcomes_of(task: str, folder: Path, report: Mapping[str, Any]) -> tuple[list[Outcome], int]:
    """Outcomes of the jobs of a sweep, and how many were not given the time to end.

    Args:
      task: of all jobs.
      folder: of the sweep; it may lie elsewhere than where it ran.
      report: its `sweep.json`.
    """
    ended = [job for job in report["jobs"] if job["state"] in ("completed", "failed")]
    played = read_json(folder / FILE) if (folder / FILE).exists() else {}
    outcomes = [
        outcome_of(
            task,
            read_metrics(RunPaths(folder / Path(job["run_dir"]).name).metrics),
            seed=str(job["overrides"].get("seed")),
            completed=job["state"] == "completed",
            wall_s=job["wall_s"],
            played=played.get(Path(job["run_dir"]).name, {}),
        )
        for job in ended
    ]
    return outcomes, len(report["jobs"]) - len(ended)


def told(row: Mapping[str, Any]) -> str:
    """A row in one line."""
    if not row["seeds"]:
        return f"{row['row']}: no training has ended"
    low, high = row["wilson"]
    text = f"{row['row']}: {row['successes']} of {row['seeds']} ({low:.0%} to {high:.0%})"
    for name in ("final", "peak", "return"):
        if row[name]:
            text += f", {name} {_spread(row[name])}"
    for name, quartiles in row["at_end"].items():
        if name.startswith("played/"):
            text += f", {name} {_spread(quartiles)}"
    if row.get("p_final") is not None:
        text += f"; p {row['p_successes']} for successes, {row['p_final']} for final rewards"
    return text


def _spread(quartiles: Sequence[float]) -> str:
    low, middle, high = quartiles
    return f"{middle:.4g} ({low:.4g} to {high:.4g})"


def main() -> int:
    """Trains what the command line asks for; returns 1 if a job failed, 2 on bad input, else 0."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments = _arguments()
    rows = [row_of(text) for text in arguments.row]
    try:
        benchmark = Benchmark(arguments, checked(arguments, rows))
        for folder in arguments.analyse:
            benchmark.analyse(folder)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    try:
        benchmark.run(rows)
    except KeyboardInterrupt:
        return 130
    if not rows:
        sys.stdout.write(f"{json.dumps(benchmark.rows)}\n")
    return int(any(row["status"] == "failed" for row in benchmark.rows))


def checked(arguments: argparse.Namespace, rows: Sequence[Row]) -> str:
    """The name of the task.

    Raises:
      ConfigError: a setting that is not one, two rows of one name, no such sweep, nothing to do.
    """
    config = gmijax.compose(*arguments.overrides)
    for row in rows:
        gmijax.compose(*arguments.overrides, *row.overrides)
    folders = [row.folder for row in rows]
    if twice := [row.name for row in rows if folders.count(row.folder) > 1]:
        raise ConfigError(f"--row {twice[0]}: two rows have this name")
    for folder in arguments.analyse:
        if not (folder / "sweep.json").exists():
            raise ConfigError(f"--analyse {folder}: has no sweep.json")
    if not rows and not arguments.analyse:
        raise ConfigError("nothing to do: expected --row or --analyse")
    return config.env.slug


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", help="of all runs, e.g. env=ant")
    parser.add_argument(
        "--row",
        action="append",
        default=[],
        metavar="'NAME: OVERRIDE ...'",
        help="a setting; the first one is the baseline",
    )
    parser.add_argument("--seeds", type=int, default=20, help="runs of a row")
    parser.add_argument("--at-once", default="8", help="runs at once on every GPU, or auto")
    parser.add_argument(
        "--play",
        type=int,
        default=0,
        metavar="EPISODES",
        help="of the last and the best checkpoint of every run, without noise; see "
        "run.checkpoint_every",
    )
    parser.add_argument(
        "--pack", default="gmi", choices=["gmi", "auto"], help="sweep.pack: auto is one program"
    )
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument(
        "--runs", type=Path, help="keep the sweeps here, and go on with those that are there"
    )
    parser.add_argument(
        "--analyse",
        type=Path,
        nargs="*",
        default=[],
        metavar="FOLDER",
        help="rows of sweeps that are there, before those that are run; the first one is then "
        "the baseline",
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(main())
