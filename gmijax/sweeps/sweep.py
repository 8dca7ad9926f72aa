"""Sweeps: many training runs of gmijax."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self, cast

from rich.console import Console

from gmijax.config import ClusterConfig, TrainConfig
from gmijax.config.schema import from_dict, require_config, to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import Show, nearby
from gmijax.control.decide import with_task
from gmijax.control.large_on_cpu import large_on_cpu
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.jobs import Job, jobs_of, require_placeable, require_same, state_of
from gmijax.sweeps.jobs_per_gpu import with_jobs_per_gpu
from gmijax.sweeps.kind import Kind
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.objective import why_not_comparable, with_objective
from gmijax.sweeps.packs import require_packable
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import State
from gmijax.sweeps.runner import SweepResult, run_work
from gmijax.sweeps.slots import Site, gmis_per_slot, plan_slots
from gmijax.sweeps.space import Space
from gmijax.sweeps.study import MakeJob
from gmijax.sweeps.training import TrainingKind
from gmijax.sweeps.work import Folder, Work

_COMPILES: Final = (
    "the first job of each task and size compiles its programs, up to 3 minutes; the rest "
    "load them"
)


@dataclass(frozen=True)
class SweepWork(Work[Job]):
    """Training runs; see `Work`."""

    name = "sweep"
    resume_requirement = "lists"

    @property
    def stopping(self) -> str:
        """See `Work`."""
        return "running jobs save and end; a second {} ends them at once, without saving"

    @property
    def ranking(self) -> SweepConfig:
        """See `Work`."""
        return cast("SweepConfig", self.settings)

    @property
    def configs(self) -> list[TrainConfig]:
        """Those of the jobs."""
        return [job.config for job in self.jobs]

    @property
    def on_cpu(self) -> bool:
        """See `Work`."""
        return all(job.config.plan.backend == "cpu" for job in self.jobs)

    @property
    def processes(self) -> int:
        """See `Work`."""
        return max((gmis_per_slot(job.config) for job in self.jobs), default=1)

    def paths(self, root: Path) -> SweepPaths:
        """See `Work`."""
        return SweepPaths(root, self.name)

    def sites(self, hosts: Sequence[Host]) -> list[Site]:
        """See `Work`."""
        backends = {job.config.plan.backend for job in self.jobs}
        return [
            Site(plan_slots(self.settings, host.machine, backends), host.machine, host.name)
            for host in hosts
        ]

    def require_runnable(self, sites: Sequence[Site]) -> None:
        """See `Work`."""
        require_placeable(self.jobs, min(site.plan.layout.num_gpus for site in sites))
        require_packable(with_objective(self.ranking, self.configs), self.jobs)

    def decided(
        self, hosts: Sequence[Host], console: Console, signals: StopSignals, scratch: Path | None
    ) -> Self:
        """See `Work`."""
        settings = with_jobs_per_gpu(self.ranking, self.jobs, hosts, console, signals, scratch)
        return replace(self, settings=settings)

    def next_step(self, paths: SweepPaths, best: int) -> tuple[str, str]:
        """See `Work`."""
        folder = shlex.quote(nearby(paths.run_dir(best)))
        return "play the best one, and film it", f"gmijax play run.dir={folder}"

    def kind(self, paths: SweepPaths, sites: Sequence[Site]) -> Kind[Job]:
        """See `Work`."""
        del sites
        return TrainingKind(self.ranking, paths)

    @property
    def unranked(self) -> str:
        """See `Work`."""
        return f"no completed job has a value of sweep.objective={self.ranking.objective}"

    def state_of(self, run: RunPaths, job: Job) -> State:
        """See `Work`."""
        require_same(run, job.config)
        return state_of(run, job.config)

    def described(self) -> dict[str, Any]:
        """See `Work`."""
        return {"sweep": to_dict(self.settings)}

    def identity(self) -> dict[str, Any]:
        """See `Work`."""
        return self.grid_identity()

    def warnings(self, sites: Sequence[Site]) -> Sequence[str]:
        """See `Work`."""
        is_left = any(job.progress.state != "completed" for job in self.jobs)
        warnings = [why_not_comparable(self.configs, self.ranking)]
        if is_left:
            on_cpu = {site.plan.backend for site in sites} == {"cpu"}
            large = (line for one in self.configs for line in large_on_cpu(one, on_cpu=on_cpu))
            warnings += [next(large, None), _COMPILES]
        return tuple(filter(None, warnings))


def sweep_of(
    settings: SweepConfig,
    space: Space,
    make_job: MakeJob[Job],
    jobs: Sequence[Job],
    cluster: ClusterConfig | None = None,
) -> SweepWork:
    """The work of a sweep; see `Work`."""
    run = jobs[0].config.run if jobs else None
    folder = Folder(run.dir, run.name) if run else Folder(None, None)
    return SweepWork(settings, space, make_job, tuple(jobs), cluster or ClusterConfig(), folder)


def sweep(configs: Sequence[TrainConfig], *, show: Show = False, **settings: Any) -> SweepResult:
    """Trains with every configuration, several at a time on every GPU, and compares them.

    Examples:
      >>> sweep([compose("env=ant", f"seed={seed}") for seed in range(4)], jobs_per_gpu=2)

    Args:
      configs: at least one; all with the same `run.dir` or `run.name`, the folder of the sweep,
        and the same `cluster`, whose nodes the jobs run on.
      show: print live progress and the ranking.
      settings: keys of `sweep.*`.

    Raises:
      ConfigError, SweepFailed, JobInterrupted: as `run_work`.
    """
    if isinstance(configs, TrainConfig):
        raise ConfigError("configs: expected a list of configurations; gmijax.train takes one")
    configs = tuple(configs)
    for config in configs:
        require_config(config, TrainConfig)
    clusters = {config.cluster for config in configs}
    if len(clusters) > 1:
        raise ConfigError("cluster: a sweep has one; give all configurations the same")
    jobs = jobs_of([replace(config, cluster=ClusterConfig()) for config in configs])
    own = from_dict(SweepConfig, settings)
    work = sweep_of(own, {}, lambda n, _: jobs[n], jobs, *clusters)
    return run_sweep(work, show=show)


def run_sweep(work: SweepWork, *, show: Show = False) -> SweepResult:
    """Trains all jobs; see `run_work`."""

    def pinned(job: Job) -> Job:
        return replace(job, config=with_task(job.config))

    # The tasks of all jobs are pinned, also of those that are still to be made.
    make_job, jobs = work.make_job, tuple(map(pinned, work.jobs))
    work = replace(
        work, jobs=jobs, make_job=lambda number, chosen: pinned(make_job(number, chosen))
    )
    if jobs:
        work = replace(work, settings=with_objective(work.ranking, [job.config for job in jobs]))
    return run_work(work, show=show)
