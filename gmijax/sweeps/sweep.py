"""The controller of a sweep: from jobs to a ranking. No jax here."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.config import PlanConfig, ReduceConfig, TrainConfig
from gmijax.config.schema import from_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import open_console
from gmijax.control.decide import with_task
from gmijax.errors import ConfigError, JobInterrupted, SweepFailed
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import create_run, given_run, locked, read_json
from gmijax.supervise.backends import open_backend
from gmijax.supervise.launcher import stop_signals
from gmijax.sweeps.jobs import (
    Job,
    Progress,
    SweepPaths,
    jobs_of,
    require_placeable,
    state_of,
)
from gmijax.sweeps.leases import leased
from gmijax.sweeps.report import ranking, write_report
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.view import SweepView


class SweepResult(NamedTuple):
    """Result of a sweep.

    Attributes:
      root: its folder.
      report: the content of its `sweep.json`.
    """

    root: Path
    report: dict[str, Any]


def sweep(configs: Sequence[TrainConfig], *, show: bool = False, **settings: Any) -> SweepResult:
    """Trains with every configuration, several at a time on every GPU, and compares them.

    Example:
      >>> sweep([compose("env=ant", f"seed={seed}") for seed in range(4)], jobs_per_gpu=2)

    Args:
      configs: at least one; all with the same `run.dir` or `run.name`, the folder of the sweep.
      show: print live progress and the ranking.
      settings: keys of `sweep.*`.

    Raises:
      ConfigError, SweepFailed, JobInterrupted: as `run_jobs`.
    """
    return run_jobs(from_dict(SweepConfig, settings), jobs_of(configs), show=show)


def run_jobs(settings: SweepConfig, jobs: Sequence[Job], *, show: bool = False) -> SweepResult:
    """Trains all jobs, as many at a time as the settings say, and compares them.

    Called again with the same jobs and folder, it runs those that are not complete.

    Args:
      settings: how jobs share the GPUs, and what they are compared by.
      jobs: at least one; all with the same `run.dir` or `run.name`, the folder of the sweep.
      show: print live progress and the ranking.

    Raises:
      ConfigError: bad input, before anything was started.
      SweepFailed: a job failed; all others have run.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came, and all jobs have saved and ended.
    """
    started_s = time.monotonic()
    jobs = tuple(replace(job, config=with_task(job.config)) for job in jobs)
    machine, console = detect_machine(), open_console(show=show)
    plan = plan_of(settings, machine)
    require_placeable(jobs, plan.layout.num_gpus)
    paths = _open(jobs)
    with locked(paths.lock, f"run.dir={paths.root}"):
        progress = _note(settings, jobs, paths)
        _announce(console, paths, plan, jobs, progress)
        view = SweepView(console, jobs, progress, settings)
        status = "failed"
        try:
            with stop_signals() as signals, ExitStack() as held:
                devices = {share.device for share in plan.slices} - {"cpu"}
                held.enter_context(leased(devices, console.print, lambda: signals.have_come))
                backend = held.enter_context(open_backend(plan, machine, paths))
                held.enter_context(view)
                Scheduler(jobs, progress, settings, paths, plan, backend, view.update).run(signals)
            failed = [job for job in jobs if progress[job.number].state != "completed"]
            status = "failed" if failed else "completed"
        except JobInterrupted as error:
            status = "interrupted"
            error.add_note(f"the same command with run.dir={paths.root} goes on")
            raise
        finally:
            wall_s = time.monotonic() - started_s
            report = write_report(status, jobs, progress, settings, paths, wall_s)
    console.print(ranking(report["jobs"], settings))
    console.print(f"{view.line()}\nsummary: {paths.sweep}", markup=False)
    if failed:
        first = progress[failed[0].number]
        raise SweepFailed(
            f"{len(failed)} of {len(jobs)} jobs failed; job {failed[0].number}: {first.error}"
        )
    return SweepResult(paths.root, report)


def plan_of(settings: SweepConfig, machine: Machine) -> Plan:
    """Places for jobs as the slices of GMIs that do not know each other."""
    gpus = settings.gpus
    if gpus is None:
        gpus = max(1, len(machine.gpus))
    try:
        config = PlanConfig(gpus=gpus, gmis_per_gpu=settings.jobs_per_gpu)
        return make_plan(config, ReduceConfig(), 1, machine, template="tcg")
    except ConfigError as error:
        said = str(error).replace("plan.gmis_per_gpu", "sweep.jobs_per_gpu")
        raise ConfigError(said.replace("plan.gpus", "sweep.gpus")) from None


def _open(jobs: Sequence[Job]) -> SweepPaths:
    """The folder of the sweep, made if it is not there."""
    run = jobs[0].config.run
    folder = given_run(run.dir, run.name)
    if folder is None or not folder.exists():
        return SweepPaths(create_run(run.dir, run.name, "sweep").root)
    paths = SweepPaths(folder.resolve())
    if not paths.sweep.exists() and any(path != paths.lock for path in folder.iterdir()):
        raise ConfigError(f"run.dir={folder}: is no folder of a sweep, and not empty")
    return paths


def _note(settings: SweepConfig, jobs: Sequence[Job], paths: SweepPaths) -> dict[int, Progress]:
    """How far the jobs are; refuses a folder with other jobs."""
    wanted = [dict(job.overrides) for job in jobs]
    if paths.sweep.exists():
        there = [row["overrides"] for row in read_json(paths.sweep)["jobs"]]
        if there != wanted:
            raise ConfigError(
                f"run.dir={paths.root}: holds a sweep of {len(there)} other jobs; give the same "
                "lists, or another folder"
            )
    progress = {job.number: Progress() for job in jobs}
    for job in jobs:
        run, own = paths.job(job.number), progress[job.number]
        own.state = state_of(run, job.config)
        own.read(run, settings)
    write_report("running", jobs, progress, settings, paths, 0.0)
    return progress


def _announce(
    console: Console,
    paths: SweepPaths,
    plan: Plan,
    jobs: Sequence[Job],
    progress: Mapping[int, Progress],
) -> None:
    console.print(f"sweep folder: {paths.root}", markup=False)
    done = sum(own.state == "completed" for own in progress.values())
    more = f", {done} of them complete already" if done else ""
    gmis = len(plan.slices)
    console.print(
        f"{len(jobs)} jobs{more}, {gmis} at a time on {plan.layout.num_gpus} GPUs, backend "
        f"{plan.backend}",
        markup=False,
    )
    for reason in plan.reasons:
        console.print(f"  {reason}", markup=False)
