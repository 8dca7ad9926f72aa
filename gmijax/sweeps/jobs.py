"""The jobs of a sweep: what they are, where their files are, how far they are."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

from gmijax.config import BackendName, TrainConfig
from gmijax.config.schema import flatten, to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import number_in, read_metrics
from gmijax.sweeps.objective import find, value_of
from gmijax.sweeps.places import Place

State: TypeAlias = Literal["waiting", "running", "completed", "failed", "pruned", "interrupted"]

DIGITS = 3
"""Of the number of a job in the names of its files; more jobs have more digits."""


class SweepPaths(RunPaths):
    """Files of a sweep; each job has a run folder of its own in it."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.request = root / "request.json"  # What was asked: a command that goes on asks it too.
        self.study = root / "study.log"  # Of Optuna.
        self.sweep = root / "sweep.json"  # Jobs, their states and results.
        self.table = root / "sweep.csv"  # One line a job.
        self.settings = root / "settings.csv"  # One line for all seeds of a setting.
        self.room = root / ".room"  # Of no use but its size: room for how the sweep ends.
        self.curves = root / "sweep.png"

    def job(self, number: int) -> RunPaths:
        """The run folder of a job."""
        return RunPaths(self.root / f"{number:0{DIGITS}d}")

    def order(self, number: int) -> Path:
        """What the process of a job is told."""
        return self.root / "jobs" / f"{number:0{DIGITS}d}.json"

    def log(self, number: int) -> Path:
        """What the process of a job prints."""
        return self.root / "jobs" / f"{number:0{DIGITS}d}.log"


@dataclass
class Progress:
    """How far a job is.

    Attributes:
      state: see `State`.
      env_steps: environment steps so far.
      env_steps_per_s: of the last iteration; 0 while it does not run.
      value: what it is ranked by (`value_of`), None before there is one.
      is_full: whether the value can be compared, see `Found`.
      episodes: how many the value is a mean over, where that is known.
      latest: the objective in the latest line that has it, over the short window.
      started_s: when this command started it, by the monotonic clock.
      updated_s: when the first line of metrics came after that.
      ended_s: when it ended after that.
      earlier_s: seconds that it took, where an earlier command has completed it.
      place: GPUs and places where it runs, in words.
      node: address of the node where it runs or ran last; None: this machine.
      error: why it failed, in one line.
      curve: environment steps and objective of the lines of metrics that can be compared, or,
        while there are none, of the others.
    """

    state: State = "waiting"
    env_steps: int = 0
    env_steps_per_s: float = 0.0
    value: float | None = None
    is_full: bool = True
    episodes: int | None = None
    latest: float | None = None
    started_s: float | None = None
    updated_s: float | None = None
    ended_s: float | None = None
    earlier_s: float = 0.0
    place: str = ""
    node: str | None = None
    error: str | None = None
    curve: list[tuple[int, float]] = field(default_factory=list)

    @property
    def wall_s(self) -> float:
        """Seconds from its start to its end, or until now."""
        if self.started_s is None:
            return self.earlier_s
        return (self.ended_s or time.monotonic()) - self.started_s

    def begin(self, place: str, node: str | None) -> None:
        """Its process was started there."""
        self.state, self.place, self.node, self.error = "running", place, node, None
        self.started_s, self.updated_s, self.ended_s = time.monotonic(), None, None

    def take(self, line: Mapping[str, Any], sweep: SweepConfig) -> None:
        """Takes in a line of metrics."""
        self.env_steps = line["env_steps"]
        self.env_steps_per_s = line.get("env_steps_per_s") or 0.0
        if (found := find(line, sweep.objective)) is None:
            return
        latest = number_in(line, sweep.objective)
        self.latest = found.number if latest is None else latest
        if self.curve and self.is_full and not found.is_full:
            return
        if not self.is_full and found.is_full:
            self.curve.clear()
        self.is_full, self.episodes = found.is_full, found.episodes
        self.curve.append((self.env_steps, found.number))
        self.value = value_of(self.curve, sweep)

    def read(self, run: RunPaths, sweep: SweepConfig) -> None:
        """Takes in all metrics that a run folder has."""
        self.value, self.latest, self.curve = None, None, []
        self.is_full, self.episodes = True, None
        for line in read_metrics(run.metrics):
            self.take(line, sweep)
        self.env_steps_per_s = 0.0


@dataclass(frozen=True)
class Job:
    """One run of a sweep.

    Attributes:
      number: from 0.
      overrides: what makes it different from the other jobs, e.g. `{"seed": "1"}`.
      config: of the run.
      progress: how far it is.
    """

    number: int
    overrides: Mapping[str, str]
    config: TrainConfig
    progress: Progress = field(default_factory=Progress)

    @property
    def label(self) -> str:
        """The overrides in one line; nothing if there are none."""
        return label_of(self.overrides)

    @property
    def num_gpus(self) -> int:
        """How many GPUs it takes a place on."""
        return self.config.plan.num_gpus

    @cached_property
    def program(self) -> str:
        """The same for jobs that compile the same programs."""
        data = to_dict(self.config)
        for key in ("run", "seed", "num_timesteps", "search", "wandb"):
            del data[key]
        data["plan"].pop("memory_fraction")
        data["algo"].pop("learning_rate")  # It is in the learner's state.
        return repr(data)


def label_of(overrides: Mapping[str, str]) -> str:
    """Overrides in one line."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def jobs_of(configs: Sequence[TrainConfig]) -> tuple[Job, ...]:
    """Jobs with the keys in which the configurations differ as their overrides."""
    flat = [flatten(to_dict(config)) for config in configs]
    keys = dict.fromkeys(key for one in flat for key in one)
    differing = [key for key in keys if len({repr(one.get(key)) for one in flat}) > 1]
    return tuple(
        Job(number, {key: str(one[key]) for key in differing if key in one}, config)
        for number, (one, config) in enumerate(zip(flat, configs, strict=True))
    )


def trainings_per_hour(jobs: Sequence[Job]) -> float | None:
    """Of the jobs that this command has run, from the first start to the last end, or until now.

    None: it has not started any.
    """
    run = [job.progress for job in jobs if job.progress.started_s is not None]
    if not run:
        return None
    first_s = min(progress.started_s or 0.0 for progress in run)
    last_s = max(progress.ended_s or time.monotonic() for progress in run)
    return 3600 * sum(progress.state == "completed" for progress in run) / (last_s - first_s)


def require_placeable(jobs: Sequence[Job], num_gpus: int) -> None:
    """Refuses jobs that say themselves where they run, or that no place is large enough for.

    Raises:
      ConfigError: names the key.
    """
    if not jobs:
        raise ConfigError("sweep: there is no job in it")
    for job in jobs:
        plan = job.config.plan
        if not isinstance(plan.gpus, int):
            raise ConfigError(
                f"plan.gpus={list(plan.gpus)}: a sweep chooses the GPUs of its jobs; expected a "
                "number (sweep.gpus says which ones it may use)"
            )
        if plan.layout is not None or plan.memory_fraction is not None:
            key = "layout" if plan.layout is not None else "memory_fraction"
            raise ConfigError(f"plan.{key}: a sweep decides it for its jobs; leave it out")
        if job.num_gpus > num_gpus:
            raise ConfigError(f"plan.gpus={job.num_gpus}: the sweep has {num_gpus} GPUs")
        if job.config.run.resume not in (None, "auto"):
            raise ConfigError(
                f"run.resume={job.config.run.resume}: the jobs of a sweep start from nothing, or "
                "go on where the same sweep was interrupted"
            )


def placed(
    job: Job, run: RunPaths, place: Place, backend: BackendName | Literal["auto"]
) -> TrainConfig:
    """The configuration of a job in its run folder and its place."""
    wanted = job.config.plan
    plan = dataclasses.replace(
        wanted,
        backend=backend if wanted.backend == "auto" else wanted.backend,
        memory_fraction=place.memory_fraction(job.config),
        # The daemon is the sweep's, and caps nobody.
        self_check="off" if wanted.self_check == "auto" else wanted.self_check,
    )
    wandb = job.config.wandb
    wandb = dataclasses.replace(wandb, group=wandb.group or run.root.parent.name)
    return dataclasses.replace(started_in(job.config, run), plan=plan, wandb=wandb)


def started_in(config: TrainConfig, run: RunPaths) -> TrainConfig:
    """The configuration of a job in its run folder, where it goes on from what is there."""
    own = dataclasses.replace(config.run, dir=str(run.root), name=None, resume="auto")
    return dataclasses.replace(config, run=own)


def state_of(run: RunPaths, config: TrainConfig) -> State:
    """Whether an earlier attempt at the sweep has completed a job."""
    if not run.summary.exists():
        return "waiting"
    summary = read_json(run.summary)
    steps = summary.get("env_steps")
    is_far = isinstance(steps, int | float) and steps >= config.num_timesteps
    return "completed" if summary.get("status") == "completed" and is_far else "waiting"
