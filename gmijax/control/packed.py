"""The controller of several trainings that are one program of one GMI. No jax here.

Each of them has a run folder as if it had been trained alone. The first one's also has the log of
the GMI, and the restarts of all.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.control.console import ConsoleProgress, announce, open_console
from gmijax.control.decide import Decided, decide
from gmijax.control.job import started_from, what_is_left
from gmijax.control.restarts import Attempts, clear_unfinished
from gmijax.control.start_point import StartPoint, find_start_point
from gmijax.control.summary import train_outcome, train_summary
from gmijax.errors import GmijaxError
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, add_event, locked, read_json, write_json
from gmijax.runs.git import record_git
from gmijax.runs.history import MetricsReader, draw_returns
from gmijax.runs.resume import CheckpointMeta
from gmijax.supervise.job_kinds import MEMBERS_VARIABLE, PACKED
from gmijax.supervise.run_gmis import Launch, recorded


class _Member(NamedTuple):
    """One of the trainings."""

    config: TrainConfig
    run: RunPaths
    beginning: StartPoint


def train_packed(configs: Sequence[TrainConfig], *, show: bool = False) -> None:
    """Trains with all configurations at once; returns when all have ended.

    Args:
      configs: they differ in seed, learning rate and run folder alone, and begin at the same step.
      show: print the plan, live progress and the outcomes.

    Raises:
      ConfigError, GmiFailed, JobInterrupted: as `train`, for all of them.
      GmijaxError: some have failed, and the others are complete.
    """
    started_s = time.monotonic()
    beginnings = [find_start_point(config) for config in configs]
    console = open_console(show=show)
    decided = decide(configs[0], console)
    with ExitStack() as held:
        members: list[_Member] = []
        for config, beginning in zip(configs, beginnings, strict=True):
            run = beginning.open(config)
            held.enter_context(locked(run.lock, f"run.dir={run.root}"))
            record_git(run, Path.cwd())
            own = dataclasses.replace(config, physics=decided.config.physics)
            members.append(_Member(own, run, beginning))
        what = f"{len(configs)} trainings of {decided.plan.num_envs_per_gmi} environments at once"
        lines = (*decided.reasons, *beginnings[0].notes)
        announce(console, members[0].run, decided.plan, what, lines)
        _Pack(decided, members, console).run_to_the_end(started_s)


class _Pack:
    """Trainings that are ready to start."""

    def __init__(
        self, decided: Decided[TrainConfig], members: Sequence[_Member], console: Console
    ) -> None:
        self._plan, self._machine = decided.plan, decided.machine
        self._members, self._console = members, console
        self._first = first = members[0]
        restarts = first.config.run.max_restarts
        self._attempts = Attempts(first.run, restarts, self._launch_at, console.print)

    def run_to_the_end(self, started_s: float) -> None:
        """Runs them, with restarts; writes the summaries however they end."""
        first = self._first
        for member in self._members:
            write_json(member.run.plan, self._plan.to_dict())
            member.run.gmi(0).error.unlink(missing_ok=True)
            if member.beginning.folder is not None:
                clear_unfinished(member.run, member.beginning.checkpoint)
        new = MetricsReader(first.run.metrics).new
        progress = ConsoleProgress(self._console, new, first.config.num_timesteps)
        record = partial(self._record, started_s)
        with recorded(first.run, partial(what_is_left, first.run), record), progress:
            self._attempts.run_to_the_end(first.beginning.checkpoint, progress.update)
        if failed := [member for member in self._members if _has_failed(member.run)]:
            told = read_json(failed[0].run.gmi(0).error)
            raise GmijaxError(
                f"{len(failed)} of {len(self._members)} trainings failed; {failed[0].run.root}: "
                f"{told['type']}: {told['message']}"
            )

    def _launch_at(self, checkpoint: Path | None, attempt: int) -> Launch:
        steps = None if checkpoint is None else CheckpointMeta.read(checkpoint).env_steps
        runs: list[str] = []
        for member in self._members:
            if attempt and _has_failed(member.run):
                continue  # It would fail again.
            own = None if steps is None else member.run.checkpoint(steps)
            if attempt and member is not self._first:
                clear_unfinished(member.run, own)
            member.run.gmi(0).root.mkdir(exist_ok=True)
            write_json(member.run.config, to_dict(started_from(member.config, own)))
            runs.append(str(member.run.root))
        return Launch(
            plan=self._plan,
            machine=self._machine,
            run=self._first.run,
            kind=PACKED,
            timeouts=self._first.config.run,
            variables={MEMBERS_VARIABLE: json.dumps(runs)},
            on_warning=self._console.print,
        )

    def _record(self, started_s: float, status: str, plan: Plan) -> None:
        wall_s = time.monotonic() - started_s
        restarts = [restart._asdict() for restart in self._attempts.restarts]
        for config, run, _ in self._members:
            own = "failed" if _has_failed(run) else status
            add_event(run.events, own)
            write_json(run.plan, plan.to_dict())
            summary = train_summary(config, plan, run, own, wall_s, restarts)
            write_json(run.summary, summary)
            draw_returns(run.metrics, run.returns_png, f"{config.env.label}, {config.algo.name}")
            if own == "completed":
                self._console.print(train_outcome(summary, run))


def _has_failed(run: RunPaths) -> bool:
    """Whether a training has ended before the others."""
    return run.gmi(0).error.exists()
