"""What the user sees of a running sweep: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Self

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from gmijax.config.sweep import Ranking
from gmijax.control.display import LiveDisplay, bar, clock
from gmijax.control.time_left import TimeLeft
from gmijax.sweeps.any_job import AnyJob, label_of, trainings_per_hour
from gmijax.sweeps.progress import Progress
from gmijax.sweeps.report import shown

_HEADINGS = (
    *("job", "overrides", "GPU and slot", "progress", "steps/s", "{}", "ranked by", "ETA"),
    "state",
)
_MOST_ROWS = 30
_BAR_WIDTH = 6
_LONG_LABEL = 80
_ORDER = ("running", "failed", "interrupted", "waiting", "pruned", "completed")


class SweepView:
    """Shows all jobs while it is entered.

    Args:
      console: nothing is shown on a quiet one.
      jobs: those that are known; more may be added to the list.
      ranking: what they are compared by.
      stopping: the line about running jobs after a signal, whose name replaces `{}`.
    """

    def __init__(
        self, console: Console, jobs: Sequence[AnyJob], ranking: Ranking, stopping: str
    ) -> None:
        self._console, self._jobs, self._ranking = console, jobs, ranking
        self._stopping = stopping
        self._stages: dict[int, tuple[str, int, str | None]] = {}
        self._named: set[int] = set()
        self._left: defaultdict[int, TimeLeft] = defaultdict(TimeLeft)
        self._display = LiveDisplay(console)
        self._is_stopping = False

    def __enter__(self) -> Self:
        self._display.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._display.__exit__(*exc)
        self._display.show(self._print_changes)

    def update(self, stopped_by: str = "") -> None:
        """Called about ten times a second; `stopped_by`: as of `GmiStatus`."""
        if stopped_by and not self._is_stopping:
            self._is_stopping = True
            self._console.print(f"stopping: {self._stopping.format(stopped_by)}")
        self._display.show(self._show)

    def line(self) -> str:
        """How far the whole sweep is."""
        states = [job.progress.state for job in self._jobs]
        counts = ", ".join(f"{states.count(state)} {state}" for state in _ORDER if state in states)
        running = [job.progress for job in self._jobs if job.progress.state == "running"]
        rate = sum(progress.env_steps_per_s for progress in running)
        per_hour = trainings_per_hour(self._jobs)
        parts = [f"{rate:,.0f} steps/s"] if rate else []
        parts += [f"{per_hour:,.1f} runs/h"] if per_hour else []
        return "; ".join(filter(None, (counts, ", ".join(parts))))

    def _show(self) -> Group | None:
        for job in self._jobs:
            if job.progress.state == "running" and job.progress.env_steps:
                self._left[job.number].note(job.progress.env_steps)
        self._print_changes()
        return Group(self._table(), Text(self.line())) if self._display.has_panel else None

    def _print_changes(self) -> None:
        """New stages of jobs; beside the table only those that the user may have to fix."""
        for job in self._jobs:
            before = self._stages.get(job.number, ("waiting", 0, None))
            state, _, waits_for = now = job.progress.stage
            self._stages[job.number] = now
            is_due = state == "failed" or waits_for or not self._display.has_panel
            # What an earlier command has done is no news, and took no time of this one.
            is_earlier = state in ("completed", "pruned") and job.progress.started_s is None
            if now != before and is_due and not is_earlier:
                self._console.print(self._change(job, job.progress))

    def _change(self, job: AnyJob, progress: Progress) -> str:
        # A long label, such as a command with its arguments, is printed only once.
        is_named = job.number not in self._named or len(job.label) <= _LONG_LABEL
        self._named.add(job.number)
        words = ("job", str(job.number), job.label if is_named else "")
        what = f"{' '.join(filter(None, words))}: {progress.state}"
        if progress.state == "running":
            where = f" on {progress.slot}" if progress.slot else ""
            return f"{what}{where}{f' ({progress.note})' if progress.note else ''}"
        if reasons := [word for word in (progress.error, progress.stage[2]) if word]:
            return f"{what}: {'; '.join(reasons)}"
        value = ""
        if progress.value is not None:
            found = shown(progress.value, progress.is_full, progress.episodes)
            if progress.state == "interrupted":  # It is not compared with others yet.
                found = f"{progress.value:.4g} so far"
            value = f", {self._ranking.objective} {found}"
        return f"{what} after {progress.wall_s:.0f} s{value}; {self.line()}"

    def _table(self) -> Table:
        rows = sorted(self._jobs, key=lambda job: _ORDER.index(job.progress.state))
        names = _short_names(self._jobs)
        cells = []
        for job in rows[:_MOST_ROWS]:
            label = label_of({names[key]: value for key, value in job.overrides.items()})
            left_s = self._left[job.number].seconds(job.num_timesteps or 0)
            cells.append(_row(job, job.progress, label, left_s))
        table = Table(box=None, pad_edge=False)
        # Without GPUs there are no slots; not all programs print steps, or what to rank them by.
        kept = [n for n, column in enumerate(zip(*cells, strict=True)) if any(map(str, column))]
        for heading in (_HEADINGS[number] for number in kept):
            name = heading.format(self._ranking.objective)
            is_long = heading in ("overrides", "state")
            width = 8 if is_long else None
            table.add_column(name, no_wrap=not is_long, min_width=width, overflow="fold")
        for row in cells:
            table.add_row(*(row[number] for number in kept))
        if len(rows) > _MOST_ROWS:
            table.add_row("", f"and {len(rows) - _MOST_ROWS} more")
        return table


def _ranked(progress: Progress) -> str:
    if progress.value is None:
        return ""
    return f"{progress.value:.4g}{'' if progress.is_full else ' (early)'}"


def _short_names(jobs: Sequence[AnyJob]) -> dict[str, str]:
    """Keys without their groups, where that names one key: `learning_rate`."""
    keys = {key: key.rpartition(".")[2] for job in jobs for key in job.overrides}
    last = list(keys.values())
    return {key: name if last.count(name) == 1 else key for key, name in keys.items()}


def _row(
    job: AnyJob, progress: Progress, label: str, left_s: float | None
) -> tuple[str | Text, ...]:
    total, rate = job.num_timesteps, progress.env_steps_per_s
    part = min(progress.env_steps / total, 1.0) if total else None
    steps = f"{progress.env_steps:,}" if progress.env_steps else ""
    done = steps if part is None else f" {part:.0%}"
    words = filter(None, (progress.error, progress.note))
    is_running, state = progress.state == "running", progress.state
    if is_running and progress.updated_s is None:
        # Of a program that prints no steps it is not known whether it has begun.
        state = f"{'starting' if total else 'running'} {clock(progress.wall_s)}"
    return (
        str(job.number),
        # As text: overrides and errors may look like markup.
        Text(label),
        progress.slot,
        Text(done) if part is None else Text.assemble(bar(part, _BAR_WIDTH), done),
        f"{rate:,.0f}" if rate else "",
        "" if progress.latest is None else f"{progress.latest:.4g}",
        _ranked(progress),
        clock(left_s) if is_running and left_s is not None else "",
        Text(": ".join((state, *words))),
    )
