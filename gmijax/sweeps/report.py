"""What a sweep leaves: `sweep.json`, `sweep.csv`, a ranking, and one picture of all curves."""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from rich.table import Table

from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.runs.folder import write_json, write_text
from gmijax.sweeps.jobs import Job, State, SweepPaths, label_of, trainings_per_hour
from gmijax.version import __version__

CURVE_POINTS = 200
_QUARTILES = (25, 75)


class LiveReport:
    """Keeps `sweep.json` and `sweep.csv` true while a sweep runs, so that a kill leaves them true.

    Args:
      jobs: those that are known; more may be added to the list.
      sweep: settings.
      paths: files of the sweep.
      started_s: when the command began, by the monotonic clock.
    """

    def __init__(
        self, jobs: Sequence[Job], sweep: SweepConfig, paths: SweepPaths, started_s: float
    ) -> None:
        self._jobs, self._sweep, self._paths, self._started_s = jobs, sweep, paths, started_s
        self._states: list[State] = []

    def update(self) -> None:
        """Writes them if the state of a job has changed."""
        states: list[State] = [job.progress.state for job in self._jobs]
        if states == self._states:
            return
        self._states = states
        with suppress(OSError):  # A full disk must not end the sweep.
            wall_s = time.monotonic() - self._started_s
            _write_tables("running", self._jobs, self._sweep, self._paths, wall_s)


def write_report(
    status: str,
    jobs: Sequence[Job],
    sweep: SweepConfig,
    paths: SweepPaths,
    wall_s: float,
) -> dict[str, Any]:
    """Writes the files; returns the content of `sweep.json`."""
    data = _write_tables(status, jobs, sweep, paths, wall_s)
    draw_curves(jobs, sweep, paths)
    return data


def _write_tables(
    status: str, jobs: Sequence[Job], sweep: SweepConfig, paths: SweepPaths, wall_s: float
) -> dict[str, Any]:
    first_s = min((job.progress.started_s or math.inf for job in jobs), default=math.inf)
    rows = [_row(job, paths, first_s) for job in jobs]
    data = {
        "status": status,
        "sweep": to_dict(sweep),
        "wall_s": round(wall_s, 3),
        "trainings_per_hour": trainings_per_hour(jobs),
        "ranking": [row["job"] for row in ranked(rows, sweep)],
        "jobs": rows,
        "versions": {"gmijax": __version__},
    }
    write_json(paths.sweep, data)
    write_text(paths.table, _csv(rows))
    return data


def ranked(rows: Sequence[Mapping[str, Any]], sweep: SweepConfig) -> list[Mapping[str, Any]]:
    """Rows that have a value, the best first."""
    sign = -1.0 if sweep.direction == "maximize" else 1.0
    return sorted(
        (row for row in rows if row["value"] is not None), key=lambda row: sign * row["value"]
    )


def ranking(rows: Sequence[Mapping[str, Any]], sweep: SweepConfig) -> Table:
    """The ranking for people; below it jobs without a value, such as those that have failed."""
    table = Table(box=None, pad_edge=False)
    for heading in ("rank", "job", "overrides", f"best {sweep.objective}", "steps", "state"):
        table.add_column(heading)
    listed = [(str(rank), row) for rank, row in enumerate(ranked(rows, sweep), 1)]
    listed += [("-", row) for row in rows if row["value"] is None]
    for rank, row in listed:
        value = "-" if row["value"] is None else f"{row['value']:.4g}"
        label, steps = label_of(row["overrides"]), f"{row['env_steps']:,}"
        table.add_row(rank, str(row["job"]), label, value, steps, row["state"])
    return table


def draw_curves(jobs: Sequence[Job], sweep: SweepConfig, paths: SweepPaths) -> None:
    """Draws the objective over environment steps: one line for all seeds of the same settings.

    The line is the interquartile mean over the seeds, the band the range between the quartiles
    (as rliable draws them, arXiv 2108.13264). Without any value there is no picture.
    """
    groups: dict[str, list[list[tuple[int, float]]]] = {}
    for job in jobs:
        if curve := job.progress.curve:
            own = {key: value for key, value in job.overrides.items() if key != "seed"}
            label = label_of(own) or "all seeds"
            groups.setdefault(label, []).append(curve)
    if not groups:
        return
    # Imported here: it costs half a second that no other use of this module should pay.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for label, curves in groups.items():
        steps, middle, low, high = spread(curves)
        axes.plot(steps, middle, label=f"{label} (n={len(curves)})")
        if len(curves) > 1:
            axes.fill_between(steps, low, high, alpha=0.2)
    axes.set(xlabel="environment steps", ylabel=sweep.objective)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(paths.curves, dpi=120)


def spread(
    curves: Sequence[Sequence[tuple[int, float]]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps [P], interquartile mean [P] and both quartiles [P] over curves, where all are."""
    first = max(curve[0][0] for curve in curves)
    last = min(curve[-1][0] for curve in curves)
    steps = np.linspace(first, max(first, last), CURVE_POINTS)
    values = np.stack([np.interp(steps, *np.array(curve).T) for curve in curves])
    low, high = np.percentile(values, _QUARTILES, axis=0)
    inside = (values >= low) & (values <= high)
    # With two or three curves the quartiles lie between them, and nothing else does.
    inside |= ~inside.any(axis=0)
    return steps, (values * inside).sum(axis=0) / inside.sum(axis=0), low, high


def _row(job: Job, paths: SweepPaths, first_s: float) -> dict[str, Any]:
    progress = job.progress
    start_s, update_s = progress.started_s, progress.updated_s
    return {
        "job": job.number,
        "overrides": dict(job.overrides),
        "run_dir": str(paths.job(job.number).root),
        "state": progress.state,
        "node": progress.node,
        "value": progress.value,
        "env_steps": progress.env_steps,
        "start_s": None if start_s is None else round(start_s - first_s, 3),
        "first_update_s": None if not start_s or not update_s else round(update_s - start_s, 3),
        "wall_s": round(progress.wall_s, 3),
        "error": progress.error,
    }


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    keys = list(dict.fromkeys(key for row in rows for key in row["overrides"]))
    output = io.StringIO()
    own = ("state", "value", "env_steps", "wall_s", "run_dir", "error")
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(["job", *keys, *own])
    for row in rows:
        values = [row["overrides"].get(key, "") for key in keys]
        writer.writerow([row["job"], *values, *(row[name] for name in own)])
    return output.getvalue()
