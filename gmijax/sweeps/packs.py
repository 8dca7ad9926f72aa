"""Jobs that one program can train together (`sweep.pack=vmap`): which may, and which do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.runs.resume import CheckpointMeta, newest_checkpoint
from gmijax.sweeps.jobs import Job, SweepPaths
from gmijax.sweeps.places import gmis_of_place


def why_alone(job: Job) -> str | None:
    """Why a job needs processes of its own; None if it may share a program."""
    config = job.config
    plan = config.plan
    for found, why in (
        (config.is_asynchronous or config.algo.name != "ppo", f"algo={config.algo.name}"),
        (config.num_envs == "auto", "num_envs=auto"),
        (job.num_gpus > 1 or gmis_of_place(config) > 1, "more than one GMI"),
        (plan.template not in ("auto", "tcg_ex"), f"plan.template={plan.template}"),
        (config.env.randomize != "off", f"env.randomize={config.env.randomize}"),
        (config.eval.every is not None, "eval.every"),
        (config.wandb.mode != "off", f"wandb.mode={config.wandb.mode}"),
    ):
        if found:
            return why
    return None


def require_packable(settings: SweepConfig, jobs: Sequence[Job]) -> None:
    """Refuses jobs that cannot share a program where they are told to.

    Raises:
      ConfigError: names the job and what stands in the way.
    """
    if settings.pack == "gmi":
        return
    for job in jobs:
        if (why := why_alone(job)) is not None:
            raise ConfigError(
                f"sweep.pack=vmap: job {job.number} has {why}, which needs processes of its own; "
                "allowed is gmi"
            )


def may_share(one: Job, other: Job) -> bool:
    """Whether two jobs differ in nothing but seed and learning rate."""
    own, others = (replace(job.config.run, dir=None, name=None) for job in (one, other))
    steps, other_steps = one.config.num_timesteps, other.config.num_timesteps
    return (one.program, steps, own) == (other.program, other_steps, others)


def of_one_step(job: Job, others: Sequence[Job], paths: SweepPaths) -> list[Job]:
    """Those of `others` that go on from the same step as `job`."""
    if not others:
        return []
    steps = _steps(paths.job(job.number))
    return [other for other in others if _steps(paths.job(other.number)) == steps]


def program_of(job: Job, count: int) -> str:
    """The same for `count` such jobs that compile the same programs."""
    return job.program if count == 1 else f"{count} x {job.program}"


def _steps(run: RunPaths) -> int | None:
    """Where a job goes on from."""
    checkpoint = newest_checkpoint(run.root).checkpoint
    return None if checkpoint is None else CheckpointMeta.read(checkpoint).env_steps
