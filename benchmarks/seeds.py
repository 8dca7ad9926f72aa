r"""How surely a task is learnt: `python -m benchmarks.seeds env=ball_balance --seeds 20`.

Every row is a setting, trained with the same seeds as one sweep; the first row is the baseline.

    python -m benchmarks.seeds env=ball_balance num_envs=4096 num_timesteps=10e6 \
        --row baseline --row 'no value clip: algo.clip_value_loss=false'

What counts as success is in `benchmarks/outcomes.py`. After every row
`benchmarks/results/seeds-<task>-<device>.json` is written: successes with Wilson's interval,
quartiles over seeds, and p against the baseline. At the deadline the sweep that runs is stopped;
its runs that are through are kept, and apart from them how far the others came.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gmijax
from benchmarks.outcomes import Outcome, against, outcome_of, summary
from benchmarks.records import ResultsFile, results_file
from benchmarks.runner import deadline, exit_code, in_turn, options, sweep_report
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics


class Row(NamedTuple):
    """A setting: its name, and what it changes."""

    name: str
    overrides: tuple[str, ...]

    @property
    def folder(self) -> str:
        """Its name, as a command line takes it: a comma would be a list of folders."""
        return re.sub(r"[^A-Za-z0-9_.-]+", "-", self.name)


def row_of(text: str) -> Row:
    """Of `NAME` or `NAME: OVERRIDE ...`."""
    name, _, overrides = text.partition(":")
    return Row(name.strip(), tuple(shlex.split(overrides)))


def train(
    row: Row,
    folder: Path,
    given: argparse.Namespace,
    file: ResultsFile,
    baseline: Sequence[Outcome] | None,
    deadline_s: float,
) -> Sequence[Outcome]:
    """Trains a row and writes it to the file; if interrupted, the finished runs of it."""
    task = file.results["task"]
    words = [
        *(*given.overrides, *row.overrides, f"seed=range({given.seeds})"),
        *(f"sweep.jobs_per_gpu={given.at_once}", f"sweep.pack={given.pack}"),
    ]
    started_s, code, outcomes = time.monotonic(), 130, list[Outcome]()
    try:
        code, _ = sweep_report(words, folder, deadline_s)
    finally:
        if (folder / "sweep.json").exists():
            report = read_json(folder / "sweep.json")
            outcomes, cut = outcomes_of(task, folder, report)
            found = {
                "row": row.name,
                "overrides": row.overrides,
                "code": code,
                "command_s": round(time.monotonic() - started_s, 2),
                "status": report["status"],
                "trainings_per_hour": report["trainings_per_hour"],
                "unfinished": len(report["jobs"]) - len(outcomes),
                **summary(outcomes),
                **({} if baseline is None else against(outcomes, baseline)),
                "each": [one._asdict() for one in outcomes],
                "cut": [one._asdict() for one in cut],
            }
            file.add("rows", found)
            print(line(found), flush=True)
    return outcomes


def outcomes_of(
    task: str, folder: Path, report: Mapping[str, Any]
) -> tuple[list[Outcome], list[Outcome]]:
    """Outcomes of the jobs of a sweep, and of those that began and were not given the time to end.

    Args:
      task: of all jobs.
      folder: of the sweep; it may lie elsewhere than where it ran.
      report: its `sweep.json`.
    """
    ended, cut = list[Outcome](), list[Outcome]()
    for job in report["jobs"]:
        lines = read_metrics(RunPaths(folder / Path(job["run_dir"]).name).metrics)
        has_ended = job["state"] in ("completed", "failed")
        if has_ended or lines:
            (ended if has_ended else cut).append(
                outcome_of(
                    task,
                    lines,
                    seed=str(job["overrides"].get("seed")),
                    completed=job["state"] == "completed",
                    wall_s=job["wall_s"],
                )
            )
    return ended, cut


def line(row: Mapping[str, Any]) -> str:
    """A row in one line."""
    if not row["seeds"]:
        return f"{row['row']}: no training has ended"
    low, high = row["wilson"]
    text = f"{row['row']}: {row['successes']} of {row['seeds']} ({low:.0%} to {high:.0%})"
    for name in ("final", "peak", "return"):
        if row[name]:
            low, middle, high = row[name]
            text += f", {name} {middle:.4g} ({low:.4g} to {high:.4g})"
    if row.get("p_final") is not None:
        text += f"; p {row['p_successes']} for successes, {row['p_final']} for final rewards"
    return text


def main() -> int:
    """Trains what the command line asks for; returns 1 if a job failed, else 0."""
    given = _options()
    rows = [row_of(text) for text in given.row or ["baseline"]]
    task, deadline_s = checked(given.overrides, rows), deadline(given.deadline_s)
    file = results_file(given, "seeds", f"-{task}")
    file.results["task"] = task
    baseline: Sequence[Outcome] | None = None
    # A row is expected to take as long as one before.
    for _, row in in_turn(rows, 1, deadline_s, like=lambda _: "any"):
        with tempfile.TemporaryDirectory() as scratch:
            folder = (given.runs or Path(scratch)) / row.folder
            outcomes = train(row, folder, given, file, baseline, deadline_s)
        baseline = outcomes if baseline is None else baseline
    return int(any(row["status"] == "failed" for row in file.results.get("rows", ())))


def checked(overrides: Sequence[str], rows: Sequence[Row]) -> str:
    """The name of the task.

    Raises:
      ConfigError: a setting that is not one, two rows of one name.
    """
    config = gmijax.compose(*overrides)
    for row in rows:
        gmijax.compose(*overrides, *row.overrides)
    folders = [row.folder for row in rows]
    if twice := [row.name for row in rows if folders.count(row.folder) > 1]:
        raise ConfigError(f"--row {twice[0]}: two rows have this name")
    return config.env.slug


def _options() -> argparse.Namespace:
    parser = options("seeds", __doc__)
    parser.add_argument("overrides", nargs="*", help="of all runs, e.g. env=ant")
    parser.add_argument(
        "--row",
        action="append",
        metavar="'NAME: OVERRIDE ...'",
        help="a setting; the first one is the baseline; none: that of all runs",
    )
    parser.add_argument("--seeds", type=int, default=20, help="runs of a row")
    parser.add_argument("--at-once", default="8", help="runs at once on every GPU, or auto")
    parser.add_argument(
        "--pack", default="gmi", choices=["gmi", "auto"], help="sweep.pack: auto is one program"
    )
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument(
        "--runs", type=Path, help="keep the sweeps here, and go on with those that are there"
    )
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
