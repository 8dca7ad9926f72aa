"""How far a job is, and by its lines of metrics how good."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeAlias

from gmijax.config.sweep import Ranking
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import number_in, read_metrics
from gmijax.sweeps.objective import find, value_of

State: TypeAlias = Literal["waiting", "running", "completed", "failed", "pruned", "interrupted"]

_LEAST_S: Final = 0.5
"""Lines of metrics have the time at which they are read, ten times a second."""


@dataclass
class Progress:
    """How far a job is.

    Attributes:
      state: see `State`.
      env_steps: environment steps so far.
      env_steps_per_s: of the last iteration; 0 while it does not run.
      reports: lines of metrics since it was started.
      num_timesteps: steps at its end, where its lines have them.
      value: what it is ranked by (`value_of`), None before there is one.
      is_full: whether the value can be compared, see `ObjectiveValue`.
      episodes: how many the value is a mean over, where that is known.
      latest: the objective in the latest line that has it, over the short window.
      started_s: when this command started it the last time, by the monotonic clock.
      first_started_s: when it did the first time.
      updated_s: when the first line of metrics came after that.
      reported_s: when the latest line of metrics came.
      ended_s: when it ended after that.
      earlier_s: seconds that it took, where an earlier command has completed it.
      earlier_steps_per_s: its mean rate then, where that is known.
      slot: GPUs and slots where it runs, in words.
      node: address of the node where it runs or ran last; None: this machine.
      attempts: how often this command has started it.
      exit_code: of its process, once that has ended; negative for the signal that ended it.
      note: a remark in one line on a job that continues.
      error: why it failed, in one line.
      curve: environment steps and objective of the lines of metrics that can be compared, or,
        while there are none, of the others.
    """

    state: State = "waiting"
    env_steps: int = 0
    env_steps_per_s: float = 0.0
    reports: int = 0
    num_timesteps: int | None = None
    value: float | None = None
    is_full: bool = True
    episodes: int | None = None
    latest: float | None = None
    started_s: float | None = None
    first_started_s: float | None = None
    updated_s: float | None = None
    reported_s: float | None = None
    ended_s: float | None = None
    earlier_s: float = 0.0
    earlier_steps_per_s: float | None = None
    slot: str = ""
    node: str | None = None
    attempts: int = 0
    exit_code: int | None = None
    note: str | None = None
    error: str | None = None
    curve: list[tuple[int, float]] = field(default_factory=list)
    _first_steps: int = 0

    @property
    def stage(self) -> tuple[State, int, str | None]:
        """What is reported whenever it changes: state, attempts, and what a job waits for."""
        return self.state, self.attempts, self.note if self.state == "waiting" else None

    @property
    def wall_s(self) -> float:
        """Seconds from its latest start to its end, or until now."""
        if self.started_s is None:
            return self.earlier_s
        return (self.ended_s or time.monotonic()) - self.started_s

    @property
    def mean_steps_per_s(self) -> float | None:
        """From the first line of metrics after its latest start on; None if that is too short."""
        if self.updated_s is None or self.reported_s is None:
            return self.earlier_steps_per_s if self.started_s is None else None
        passed_s = self.reported_s - self.updated_s
        return (self.env_steps - self._first_steps) / passed_s if passed_s >= _LEAST_S else None

    def report(self, line: Mapping[str, Any], ranking: Ranking) -> None:
        """Adds a new line of metrics."""
        self.take(line, ranking)
        self.reports += 1
        self.reported_s = time.monotonic()
        if self.updated_s is None:
            self.updated_s, self._first_steps = self.reported_s, self.env_steps

    def take_summary(self, summary: Mapping[str, Any]) -> None:
        """Adds the summary of an earlier command that has completed it."""
        wall_s, rate = summary.get("wall_s"), summary.get("env_steps_per_s")
        self.earlier_s = wall_s if isinstance(wall_s, float) else 0.0
        self.earlier_steps_per_s = rate if isinstance(rate, float) else None
        self.exit_code = 0

    def begin(self, slot: str, node: str | None) -> None:
        """Its process was started there."""
        self.note, self.error = self.error, None  # Why it runs again, if it does.
        self.state, self.slot, self.node = "running", slot, node
        self.attempts += 1
        self.started_s, self.updated_s, self.ended_s = time.monotonic(), None, None
        if self.first_started_s is None:
            self.first_started_s = self.started_s
        self.reports, self.reported_s, self.exit_code = 0, None, None

    def take(self, line: Mapping[str, Any], ranking: Ranking) -> None:
        """Adds a line of metrics."""
        self.env_steps = line["env_steps"]
        self.env_steps_per_s = line.get("env_steps_per_s") or 0.0
        self.num_timesteps = line.get("num_timesteps") or self.num_timesteps
        if (found := find(line, ranking.objective)) is None:
            return
        latest = number_in(line, ranking.objective)
        self.latest = found.number if latest is None else latest
        if self.curve and self.is_full and not found.is_full:
            return
        if not self.is_full and found.is_full:
            self.curve.clear()
        self.is_full, self.episodes = found.is_full, found.episodes
        self.curve.append((self.env_steps, found.number))
        self.value = value_of(self.curve, ranking)

    def read(self, run: RunPaths, ranking: Ranking) -> None:
        """Reads all metrics that a run folder has."""
        self.value, self.latest, self.curve, self.env_steps = None, None, [], 0
        self.is_full, self.episodes = True, None
        for line in read_metrics(run.metrics):
            self.take(line, ranking)
        self.env_steps_per_s = 0.0
