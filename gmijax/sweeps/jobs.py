"""The jobs of a sweep: what they are, and where they run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from gmijax.config import BackendName, TrainConfig
from gmijax.config.schema import flatten, to_dict
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.runs.names import nearby
from gmijax.runs.result import summary_of
from gmijax.runs.saved_config import config_of_run, differences
from gmijax.sim import source
from gmijax.sweeps.any_job import label_of
from gmijax.sweeps.progress import Progress, State
from gmijax.sweeps.slots import Slot

_LEARNT_WITH = ("env.", "algo.", "physics.", "num_envs", "seed")
"""Groups and keys that decide what a job learns."""


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
        """How many GPUs it takes a slot on."""
        return self.config.plan.num_gpus

    @property
    def num_timesteps(self) -> int:
        """Environment steps at its end."""
        return self.config.num_timesteps

    @property
    def program(self) -> str:
        """The same for jobs that compile the same programs."""
        return self._program

    @cached_property
    def _program(self) -> str:
        data = to_dict(self.config)
        for key in ("run", "seed", "num_timesteps", "search", "wandb"):
            del data[key]
        data["plan"].pop("memory_fraction")
        data["algo"].pop("learning_rate")  # It is in the learner's state.
        return repr(data)


def jobs_of(configs: Sequence[TrainConfig]) -> tuple[Job, ...]:
    """Jobs with the keys in which the configurations differ as their overrides."""
    flat = [flatten(to_dict(config)) for config in configs]
    keys = dict.fromkeys(key for one in flat for key in one)
    differing = [key for key in keys if len({repr(one.get(key)) for one in flat}) > 1]
    return tuple(
        Job(number, {key: str(one[key]) for key in differing if key in one}, config)
        for number, (one, config) in enumerate(zip(flat, configs, strict=True))
    )


def require_placeable(jobs: Sequence[Job], num_gpus: int) -> None:
    """Refuses jobs that set themselves where they run, or that no slot is large enough for.

    Raises:
      ConfigError: names the key.
    """
    if not jobs:
        raise ConfigError("sweep: it has no jobs")
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
                "continue where the same sweep was interrupted"
            )


def placed(
    job: Job, run: RunPaths, slot: Slot, backend: BackendName | Literal["auto"]
) -> TrainConfig:
    """The configuration of a job in its run folder and its slot."""
    wanted = job.config.plan
    plan = dataclasses.replace(
        wanted,
        backend=backend if wanted.backend == "auto" else wanted.backend,
        memory_fraction=slot.memory_fraction(job.config),
        # The daemon is the sweep's, and caps no client.
        self_check="off" if wanted.self_check == "auto" else wanted.self_check,
    )
    wandb = job.config.wandb
    wandb = dataclasses.replace(wandb, group=wandb.group or run.root.parent.name)
    return dataclasses.replace(started_in(job.config, run), plan=plan, wandb=wandb)


def started_in(config: TrainConfig, run: RunPaths) -> TrainConfig:
    """The configuration of a job in its run folder, where it continues from what is there."""
    own = dataclasses.replace(config.run, dir=str(run.root), name=None, resume="auto")
    return dataclasses.replace(config, run=own)


def state_of(run: RunPaths, config: TrainConfig) -> State:
    """Whether an earlier attempt at the sweep has completed a job."""
    steps = (_complete(run) or {}).get("env_steps")
    is_far = isinstance(steps, int | float) and steps >= config.num_timesteps
    return "completed" if is_far else "waiting"


def require_same(run: RunPaths, config: TrainConfig) -> None:
    """Raises ConfigError if a job is complete with other settings: others are compared with it."""
    if _complete(run) is None or not run.config.exists():
        return
    saved = config_of_run(run)
    changed = [
        text
        for key, text in differences(saved, config, run).items()
        # In the run a teacher is the checkpoint that was found for what the user gave.
        if key.startswith(_LEARNT_WITH) and key != "algo.teacher"
    ]
    if edited := source.changes(config.env, saved["env"]):
        changed.append(edited)
    if changed:
        raise ConfigError(
            f"{nearby(run.root)}: this job is complete with other settings: {changed[0]}; give "
            "those, or another folder"
        )


def _complete(run: RunPaths) -> Mapping[str, Any] | None:
    """The summary of a run that is complete, for however many steps; None: it is not."""
    summary = summary_of(run)
    return summary if summary.get("status") == "completed" else None
