"""Jobs that one program can train together (`sweep.pack`): which may, and how each has ended."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from gmijax.config.sweep import SweepConfig
from gmijax.control.start_point import find_start_point
from gmijax.errors import ConfigError, with_type
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.held import is_locked
from gmijax.sweeps.jobs import Job, started_in, state_of
from gmijax.sweeps.paths import SweepPaths


class PackPlanner:
    """Finds jobs that are trained together.

    Args:
      settings: of the sweep.
      paths: its files.
    """

    def __init__(self, settings: SweepConfig, paths: SweepPaths) -> None:
        self._settings, self._paths = settings, paths
        self._begins: dict[int, int | None] = {}

    def together(self, job: Job, queue: Sequence[Job], alone: Collection[int]) -> tuple[Job, ...]:
        """The job, and those in the queue that can be trained in one program with it.

        Those of `alone`, numbers of jobs, are not put together with others.
        """
        if not self._settings.may_share_programs or why_alone(job) is not None:
            return (job,)
        is_alone, begin = job.number in alone, self._begin(job)
        if begin is None:
            return (job,)
        others = [
            other
            for other in queue
            if other is not job
            and (other.number in alone) == is_alone
            and may_share(job, other)
            and not is_locked(self._paths.job(other.number).lock)
            and self._begin(other) == begin
        ]
        return (job, *others)

    def forget(self, job: Job) -> None:
        """It has run, and begins elsewhere the next time."""
        self._begins.pop(job.number, None)

    def _begin(self, job: Job) -> int | None:
        """The step that a job continues from; None: it need not, or reports itself why it cannot.

        Kept, because it takes reading whole checkpoints.
        """
        if job.number not in self._begins:
            self._begins[job.number] = _begin_of(job, self._paths.job(job.number))
        return self._begins[job.number]


def _begin_of(job: Job, run: RunPaths) -> int | None:
    try:
        found = find_start_point(started_in(job.config, run))
    except ConfigError:
        return None
    if found.is_complete:
        return None
    return 0 if found.checkpoint is None else CheckpointMeta.read(found.checkpoint).env_steps


def why_alone(job: Job) -> str | None:
    """Why a job needs processes of its own; None if it may share a program."""
    config = job.config
    plan = config.plan
    for found, why in (
        (config.is_decoupled, f"algo={config.algo.name}"),
        (config.num_envs == "auto", "num_envs=auto"),
        (plan.gpus != 1, f"plan.gpus={plan.gpus}"),
        (plan.gmis_per_gpu != 1, f"plan.gmis_per_gpu={plan.gmis_per_gpu}"),
        (plan.template not in ("auto", "tcg_ex"), f"plan.template={plan.template}"),
        # Its states share buffers, for which a program has no axis of jobs.
        (
            config.env.suite == "playground" and config.physics.impl != "jax",
            f"env={config.env.label} with physics.impl={config.physics.impl}",
        ),
        (config.env.randomize != "off", f"env.randomize={config.env.randomize}"),
        (config.eval.every is not None, "eval.every"),
        (config.wandb.mode != "off", f"wandb.mode={config.wandb.mode}"),
        (config.run.profile is not None, "run.profile"),
    ):
        if found:
            return why
    return None


def require_packable(settings: SweepConfig, jobs: Sequence[Job]) -> None:
    """Refuses jobs that cannot share a program where they must.

    Raises:
      ConfigError: names the job and what stands in the way.
    """
    if settings.pack != "vmap":
        return
    for job in jobs:
        if (why := why_alone(job)) is not None:
            raise ConfigError(
                f"sweep.pack=vmap: job {job.number} has {why}, which needs processes of its own; "
                "allowed: auto, gmi"
            )


def may_share(one: Job, other: Job) -> bool:
    """Whether two jobs differ in nothing but seed and learning rate."""
    own, others = (replace(job.config.run, dir=None, name=None) for job in (one, other))
    steps, other_steps = one.config.num_timesteps, other.config.num_timesteps
    return (one.program, steps, own) == (other.program, other_steps, others)


def most_together(settings: SweepConfig, job: Job, jobs: Sequence[Job]) -> int:
    """How many of the jobs of a sweep one program can train at most, of the kind of `job`."""
    if not settings.may_share_programs or why_alone(job) is not None:
        return 1
    return sum(may_share(job, other) for other in jobs)


class OwnEnd(NamedTuple):
    """How a job has ended whatever became of others: complete, or failed by its `error`."""

    error: str | None


def own_end(job: Job, run: RunPaths) -> OwnEnd | None:
    """The end of a job that was trained together with others; None: it is that of the process."""
    if state_of(run, job.config) == "completed":
        return OwnEnd(None)
    if run.gmi(0).error.exists():
        error = read_json(run.gmi(0).error)
        return OwnEnd(with_type(str(error.get("type")), str(error.get("message") or "")))
    return None
