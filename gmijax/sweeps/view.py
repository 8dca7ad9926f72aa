"""What the user sees of a running sweep: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gmijax.config.sweep import SweepConfig
from gmijax.sweeps.jobs import Job, Progress

_HEADINGS = ("job", "overrides", "place", "progress", "steps/s", "best", "ETA", "state")
_MOST_ROWS = 30
_ORDER = ("running", "failed", "interrupted", "waiting", "pruned", "completed")


class SweepView:
    """Shows all jobs while it is entered.

    Args:
      console: nothing is shown on a quiet one.
      jobs: those that are known; more may be added to the list.
      sweep: settings.
    """

    def __init__(
        self,
        console: Console,
        jobs: Sequence[Job],
        sweep: SweepConfig,
    ) -> None:
        self._console, self._jobs, self._sweep = console, jobs, sweep
        self._started_s = time.monotonic()
        self._done_before = self._count("completed")
        self._states: dict[int, str] = {}
        self._has_panel = console.is_terminal and not console.quiet
        self._live = Live(console=console, refresh_per_second=2, transient=True)

    def __enter__(self) -> Self:
        if self._has_panel:
            self._live.start()
        return self

    def __exit__(self, *exc: Any) -> None:
        if self._has_panel:
            self._live.stop()
        self.update()

    def update(self) -> None:
        """Called about ten times a second."""
        if self._has_panel and self._live.is_started:
            self._live.update(Group(self._table(), Text(self.line())))
            return
        for job in self._jobs:
            progress = job.progress
            if self._states.get(job.number, "waiting") != progress.state:
                self._states[job.number] = progress.state
                self._console.print(self._change(job, progress))

    def line(self) -> str:
        """How far the whole sweep is."""
        hours = (time.monotonic() - self._started_s) / 3600
        done = self._count("completed") - self._done_before
        rate = sum(
            job.progress.env_steps_per_s for job in self._jobs if job.progress.state == "running"
        )
        counts = ", ".join(f"{n} {state}" for state in _ORDER if (n := self._count(state)))
        return f"{counts}; {rate:,.0f} steps/s, {done / hours:,.1f} trainings/h"

    def _count(self, state: str) -> int:
        return sum(job.progress.state == state for job in self._jobs)

    def _change(self, job: Job, progress: Progress) -> str:
        what = f"job {job.number} {job.label}: {progress.state}"
        if progress.state == "running":
            return f"{what} on {progress.place}"
        if progress.error:
            return f"{what}: {progress.error}"
        best = "-" if progress.value is None else f"{progress.value:.4g}"
        name = self._sweep.objective
        return f"{what} after {progress.wall_s:.0f} s, best {name} {best}; {self.line()}"

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for heading in _HEADINGS:
            table.add_column(heading, no_wrap=heading != "overrides")
        rows = sorted(self._jobs, key=lambda job: _ORDER.index(self._state(job)))
        for job in rows[:_MOST_ROWS]:
            table.add_row(*self._row(job, job.progress))
        if len(rows) > _MOST_ROWS:
            table.add_row("", f"and {len(rows) - _MOST_ROWS} more")
        return table

    def _state(self, job: Job) -> str:
        return job.progress.state

    def _row(self, job: Job, progress: Progress) -> tuple[str, ...]:
        total = job.config.num_timesteps
        part = min(progress.env_steps / total, 1.0)
        rate = progress.env_steps_per_s
        left_s = (total - progress.env_steps) / rate if rate else None
        return (
            str(job.number),
            job.label,
            progress.place,
            f"{part:.0%}",
            f"{rate:,.0f}" if rate else "",
            "" if progress.value is None else f"{progress.value:.4g}",
            "" if left_s is None else f"{left_s:,.0f} s",
            progress.error or progress.state,
        )
