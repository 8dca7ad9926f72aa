"""What a sweep leaves: tables as JSON, as CSV and for people, and one picture of all curves."""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import re
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from rich.table import Table

from gmijax.config.sweep import Ranking
from gmijax.control.display import clock
from gmijax.runs.folder import write_bytes, write_json, write_text
from gmijax.runs.held import OpenFolder
from gmijax.sweeps.any_job import AnyJob, label_of, trainings_per_hour
from gmijax.sweeps.by_setting import (
    Row,
    SeedSummary,
    grouped,
    name_of_middle,
    seed_summary,
    settings_of,
    sort_key,
)
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import State
from gmijax.version import __version__

CURVE_POINTS = 200
_OF_JOB = (
    *("state", "value", "window_full", "episodes", "env_steps", "env_steps_per_s", "wall_s"),
    *("exit_code", "run_dir", "error"),
)
_OF_SETTING = ("n", "interquartile_mean", "low", "high", "window_full")

_RESERVE_BYTES = 1 << 16

_MOST_TYPED_DIGITS = 8
"""A number with a point and more digits was sampled, not typed."""


class JobsReport:
    """The files of a sweep, true also where it is killed or the disk gets full.

    Args:
      jobs: those that are known; more may be added to the list.
      ranking: what jobs are compared by.
      described: what else the report has: the settings by the name of their group, and so on.
      paths: files of the sweep.
      folder: that of the sweep, to see whether it is still there.
      started_s: when the command began, by the monotonic clock.

    Attributes:
      data: the newest content of `sweep.json`.
    """

    def __init__(
        self,
        jobs: Sequence[AnyJob],
        ranking: Ranking,
        described: Callable[[], Mapping[str, Any]],
        paths: SweepPaths,
        folder: OpenFolder,
        started_s: float,
    ) -> None:
        self._jobs, self._ranking, self._paths, self._started_s = jobs, ranking, paths, started_s
        self._described, self._folder = described, folder
        self._states: list[tuple[State, int]] = []
        self.data: dict[str, Any] = {}

    def begin(self) -> None:
        """Writes that the sweep runs, and reserves disk space for the last report.

        Raises:
          OSError: there is none.
        """
        self._write("running")
        draw_curves(self._jobs, self._ranking, self._paths)
        size = _RESERVE_BYTES + 2 * self._paths.sweep.stat().st_size
        with self._paths.reserve.open("wb") as file:
            try:
                os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise  # Others: not every file system can reserve space.

    def update(self) -> None:
        """Writes the tables if the state of a job has changed.

        Raises:
          FolderLost: the sweep's folder is no longer there.
        """
        self._folder.require()
        states: list[tuple[State, int]] = [
            (job.progress.state, job.progress.attempts) for job in self._jobs
        ]
        if states == self._states:
            return
        self._states = states
        with suppress(OSError):  # A full disk must not end the sweep.
            self._write("running")

    def end(self, status: str) -> str | None:
        """Writes how the sweep has ended; returns why that cannot be written, if it cannot.

        Raises:
          FolderLost: the sweep's folder is no longer there.
        """
        self._folder.require()
        wrong = None
        with suppress(OSError):
            self._paths.reserve.unlink(missing_ok=True)
        for write in (
            lambda: self._write(status),
            lambda: draw_curves(self._jobs, self._ranking, self._paths),
        ):
            try:
                write()
            except OSError as error:
                wrong = wrong or f"the report cannot be written ({error.strerror or error})"
        return wrong

    def _write(self, status: str) -> None:
        wall_s = time.monotonic() - self._started_s
        found = _content(status, self._jobs, self._ranking, self._paths, wall_s)
        self.data = {**found, **self._described()}
        write_tables(self.data, self._paths)


def _content(
    status: str, jobs: Sequence[AnyJob], ranking: Ranking, paths: SweepPaths, wall_s: float
) -> dict[str, Any]:
    first_s = min((job.progress.first_started_s or math.inf for job in jobs), default=math.inf)
    rows = [_row(job, paths, first_s) for job in jobs]
    return {
        "status": status,
        "wall_s": round(wall_s, 3),
        "trainings_per_hour": trainings_per_hour(jobs),
        "settings": settings_of(rows, ranking),
        "ranking": [row["job"] for row in ranked(rows, ranking)],
        "jobs": rows,
        "versions": {"gmijax": __version__},
    }


def write_tables(data: Mapping[str, Any], paths: SweepPaths) -> None:
    """Writes the content of `sweep.json`, and its tables as CSV."""
    write_json(paths.sweep, data)
    write_text(paths.table, _csv(data["jobs"], "job", *_OF_JOB))
    settings = [_flat(setting) for setting in data["settings"]]
    write_text(paths.settings, _csv(settings, "jobs", *_OF_SETTING))


def _flat(setting: Row) -> Row:
    low, high = setting["quartiles"] or (None, None)
    jobs = " ".join(map(str, setting["jobs"]))
    return {**setting, "jobs": jobs, "low": low, "high": high}


def ranked(rows: Sequence[Row], ranking: Ranking) -> list[Row]:
    """Rows that have a value, the best first; those without a full window come last."""
    found = [row for row in rows if row["value"] is not None]
    return sorted(found, key=lambda row: sort_key(row, row["value"], ranking))


def tables(report: Mapping[str, Any], ranking: Ranking) -> list[Table]:
    """The ranking for people: of settings, where they have several seeds, and of jobs."""
    jobs = _job_table(report["jobs"], ranking)
    settings = report["settings"]
    has_seeds = any(len(setting["jobs"]) > 1 for setting in settings)
    return [_setting_table(settings, ranking), jobs] if has_seeds and report["ranking"] else [jobs]


def _setting_table(settings: Sequence[Row], ranking: Ranking) -> Table:
    labels = _labels(settings)
    num_seeds = max(setting["n"] for setting in settings)
    heading = f"{ranking.objective}, {name_of_middle(num_seeds)}"
    rows: list[Sequence[str]] = []
    for rank, (setting, own) in enumerate(zip(settings, labels, strict=True), 1):
        label, of = own or "all seeds", len(setting["jobs"])
        n = str(of) if setting["n"] == of else f"{setting['n']} of {of}"
        if setting["quartiles"] is None:
            rows.append(("-", label, "-", "-", n))
            continue
        low, high = setting["quartiles"]
        note = "" if setting["window_full"] else " (too few episodes to compare)"
        middle = f"{setting['interquartile_mean']:.4g}{note}"
        rows.append((str(rank), label, middle, f"{low:.4g} to {high:.4g}", n))
    return _table(("rank", "setting", heading, "quartiles", "n"), rows)


def _job_table(jobs: Sequence[Row], ranking: Ranking) -> Table:
    """Below the ranking are jobs without a value, such as those that have failed."""
    rows: list[Sequence[str]] = []
    is_ranked = any(row["value"] is not None for row in jobs)
    listed = [(str(rank), row) for rank, row in enumerate(ranked(jobs, ranking), 1)]
    listed += [("-", row) for row in jobs if row["value"] is None]
    labels = _labels([row for _, row in listed])
    for (rank, row), label in zip(listed, labels, strict=True):
        value = shown(row["value"], row["window_full"], row["episodes"])
        steps = row["env_steps"]
        wall = "" if is_ranked else clock(row["wall_s"])
        steps = f"{steps:,}" if steps else "-"
        rows.append((rank, str(row["job"]), label, value, steps, wall, row["state"]))
    headings = ("rank", "job", "overrides", ranking.objective, "steps", "time", "state")
    return _table(headings, rows)


def _labels(rows: Sequence[Row]) -> list[str]:
    """Overrides of every row, with sampled numbers shortened if all rows still differ."""
    whole = [label_of(row["overrides"]) for row in rows]
    short = [
        label_of({key: _short(value) for key, value in row["overrides"].items()}) for row in rows
    ]
    return short if len(set(short)) == len(set(whole)) else whole


def _short(value: str) -> str:
    """Four significant digits of a drawn number; anything else as it is."""
    mantissa = re.match(r"-?([0-9]*\.[0-9]*)(e|$)", value)  # Not an integer, as of a seed.
    digits = mantissa[1].replace(".", "").lstrip("0") if mantissa else ""
    return f"{float(value):.4g}" if len(digits) > _MOST_TYPED_DIGITS else value


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table without the columns in which there is nothing."""
    table = Table(box=None, pad_edge=False)
    cells = [column for column in zip(*rows, strict=True)] or [()] * len(headings)
    kept = [n for n, column in enumerate(cells) if set(column) - {"", "-"}]
    for number in kept:
        table.add_column(headings[number], overflow="fold")
    for row in rows:
        table.add_row(*(row[number] for number in kept))
    return table


def shown(value: float | None, is_full: bool, episodes: int | None) -> str:
    """A value for people, with a note where it cannot be compared."""
    if value is None:
        return "-"
    if is_full:
        return f"{value:.4g}"
    few = "too few episodes" if episodes is None else f"{episodes:,} episodes, too few"
    return f"{value:.4g} ({few} to compare)"


def draw_curves(jobs: Sequence[AnyJob], ranking: Ranking, paths: SweepPaths) -> None:
    """Draws the objective over environment steps: one line for all seeds of the same settings.

    The line is the interquartile mean over the seeds, the band the range between the quartiles.
    Without any value there is no picture.
    """
    drawn = grouped((job for job in jobs if job.progress.curve), lambda job: job.overrides)
    if not drawn:
        return
    # Imported here: it costs half a second that no other use of this module should pay.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    for label, own in zip(distinguishing_labels(list(drawn)), drawn.values(), strict=True):
        steps, middle = spread([job.progress.curve for job in own])
        axes.plot(steps, middle.mean, label=f"{label} (n={len(own)})")
        if len(own) > 1:
            axes.fill_between(steps, middle.low, middle.high, alpha=0.2)
    axes.set(xlabel="environment steps", ylabel=ranking.objective)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small").set_in_layout(False)  # A long one must not shrink the curves.
    drawn_png = io.BytesIO()
    figure.savefig(drawn_png, dpi=120)
    write_bytes(paths.curves, drawn_png.getvalue())


def distinguishing_labels(labels: Sequence[str]) -> list[str]:
    """Labels for a legend: without the words that all have, in two lines at most."""
    words = [label.split() for label in labels]
    shared = set.intersection(*map(set, words)) if len(labels) > 1 else set[str]()
    own = [" ".join(word for word in of_label if word not in shared) for of_label in words]
    both = zip(own, labels, strict=True)
    short = [textwrap.shorten(one or label, 130, placeholder=" ...") for one, label in both]
    return [textwrap.fill(one, 70) for one in short]


def spread(curves: Sequence[Sequence[tuple[int, float]]]) -> tuple[np.ndarray, SeedSummary]:
    """Steps [P], and the middle of curves there, [P], where all curves are."""
    first = max(curve[0][0] for curve in curves)
    last = min(curve[-1][0] for curve in curves)
    steps = np.linspace(first, max(first, last), CURVE_POINTS)
    return steps, seed_summary(
        np.stack([np.interp(steps, *np.array(curve).T) for curve in curves])
    )


def _row(job: AnyJob, paths: SweepPaths, first_s: float) -> dict[str, Any]:
    progress = job.progress
    start_s, update_s = progress.started_s, progress.updated_s
    return {
        "job": job.number,
        "overrides": dict(job.overrides),
        "run_dir": str(paths.run_dir(job.number)),
        "state": progress.state,
        "node": progress.node,
        "value": progress.value,
        "window_full": progress.is_full,
        "episodes": progress.episodes,
        "env_steps": progress.env_steps,
        "env_steps_per_s": progress.mean_steps_per_s,
        "start_s": None if start_s is None else round(start_s - first_s, 3),
        "first_update_s": None if not start_s or not update_s else round(update_s - start_s, 3),
        "wall_s": round(progress.wall_s, 3),
        "attempts": progress.attempts,
        "exit_code": progress.exit_code,
        "note": progress.note,
        "log": str(paths.log(job.number)),
        "error": progress.error,
    }


def _csv(rows: Sequence[Row], first: str, *own: str) -> str:
    """A table with the columns `first`, every override, and `own`."""
    keys = list(dict.fromkeys(key for row in rows for key in row["overrides"]))
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow([first, *keys, *own])
    for row in rows:
        values = [row["overrides"].get(key, "") for key in keys]
        writer.writerow([row[first], *values, *(row[name] for name in own)])
    return output.getvalue()
