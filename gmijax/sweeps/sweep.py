"""The controller of a sweep: from jobs to a ranking. No jax here."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import open_console
from gmijax.control.decide import with_task
from gmijax.errors import ConfigError, JobInterrupted, SweepFailed
from gmijax.machine.snapshot import detect_machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import create_run, given_run, locked, read_json, write_json
from gmijax.supervise.backends import open_backend
from gmijax.supervise.launcher import stop_signals
from gmijax.sweeps.density import with_density
from gmijax.sweeps.jobs import (
    Job,
    SweepPaths,
    jobs_of,
    require_objective,
    require_placeable,
    state_of,
)
from gmijax.sweeps.leases import leased
from gmijax.sweeps.places import Places, places_of
from gmijax.sweeps.report import ranking, write_report
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.space import Space
from gmijax.sweeps.study import MakeJob, NoStudy, OptunaStudy, Study
from gmijax.sweeps.view import SweepView


class Request(NamedTuple):
    """A sweep to be run.

    Attributes:
      settings: how jobs share the GPUs, and what they are compared by.
      space: what the keys of jobs may be.
      make_job: a job with values of the space.
      jobs: all of a grid; of another sampler some that stand for all, to be checked.
    """

    settings: SweepConfig
    space: Space
    make_job: MakeJob
    jobs: tuple[Job, ...]


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
      ConfigError, SweepFailed, JobInterrupted: as `run_request`.
    """
    jobs = jobs_of(configs)
    request = Request(from_dict(SweepConfig, settings), {}, lambda n, _: jobs[n], jobs)
    return run_request(request, show=show)


def run_request(request: Request, *, show: bool = False) -> SweepResult:
    """Trains all jobs, as many at a time as the settings say, and compares them.

    Called again with the same request and folder, it runs those that are not complete.

    Raises:
      ConfigError: bad input, before anything was started.
      SweepFailed: a job failed; all others have run.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came, and all jobs have saved and ended.
    """
    started_s = time.monotonic()
    settings, machine, console = request.settings, detect_machine(), open_console(show=show)
    request = _with_tasks(request)
    backends = {job.config.plan.backend for job in request.jobs}
    # Before anything is started: whether there are such GPUs, and room for so many jobs.
    plan = places_of(settings, machine, backends)
    require_placeable(request.jobs, plan.layout.num_gpus)
    require_objective(request.jobs, settings)
    paths = _open(request.jobs)
    with locked(paths.lock, f"run.dir={paths.root}"):
        jobs, study = _beginning(request, paths)
        write_report("running", jobs, settings, paths, 0.0)
        console.print(f"sweep folder: {paths.root}")
        view = SweepView(console, jobs, settings)
        status = "failed"
        try:
            with stop_signals() as signals, ExitStack() as held:
                devices = {share.device for share in plan.slices} - {"cpu"}
                wait = leased(devices, console.print, lambda: signals.have_come)
                if not held.enter_context(wait):
                    raise JobInterrupted("interrupted")
                settings = with_density(settings, request.jobs, machine, console, signals)
                plan = places_of(settings, machine, backends)
                _announce(console, plan, request, jobs)
                backend = held.enter_context(open_backend(plan, machine, paths))
                held.enter_context(view)
                places = Places(plan, machine)
                scheduler = Scheduler(jobs, study, settings, paths, places, backend, view.update)
                scheduler.run(signals)
            failed = [job for job in jobs if job.progress.state == "failed"]
            status = "failed" if failed else "completed"
        except JobInterrupted as error:
            status = "interrupted"
            error.add_note(f"the same command with run.dir={paths.root} goes on")
            raise
        finally:
            report = write_report(status, jobs, settings, paths, time.monotonic() - started_s)
    console.print(ranking(report["jobs"], settings))
    console.print(f"{view.line()}\nsummary: {paths.sweep}")
    if failed:
        raise SweepFailed(
            f"{len(failed)} of {len(jobs)} jobs failed; job {failed[0].number}: "
            f"{failed[0].progress.error}"
        )
    return SweepResult(paths.root, report)


def _with_tasks(request: Request) -> Request:
    """The request with the tasks of all jobs pinned, also of those that are still to be made."""

    def pinned(job: Job) -> Job:
        return replace(job, config=with_task(job.config))

    return request._replace(
        jobs=tuple(map(pinned, request.jobs)),
        make_job=lambda number, chosen: pinned(request.make_job(number, chosen)),
    )


def _open(jobs: Sequence[Job]) -> SweepPaths:
    """The folder of the sweep, made if it is not there."""
    run = jobs[0].config.run
    folder = given_run(run.dir, run.name)
    if folder is None or not folder.exists():
        return SweepPaths(create_run(run.dir, run.name, "sweep").root)
    paths = SweepPaths(folder.resolve())
    if not paths.request.exists() and any(path != paths.lock for path in folder.iterdir()):
        raise ConfigError(f"run.dir={folder}: is no folder of a sweep, and not empty")
    return paths


def _beginning(request: Request, paths: SweepPaths) -> tuple[list[Job], Study]:
    """The jobs that are known, as far as an earlier command has come, and where more come from.

    Raises:
      ConfigError: the folder holds another sweep, or a package is missing.
    """
    settings, wanted = request.settings, _described(request)
    if paths.request.exists() and read_json(paths.request) != wanted:
        raise ConfigError(
            f"run.dir={paths.root}: holds another sweep; give the same lists, or another folder"
        )
    study: Study = NoStudy()
    jobs = list(request.jobs)
    if settings.sampler != "grid":
        study = OptunaStudy(settings, request.space, request.make_job, paths.study)
        jobs = study.earlier()
    for job in jobs:
        run = paths.job(job.number)
        job.progress.read(run, settings)
        if job.progress.state != "pruned":
            job.progress.state = state_of(run, job.config)
    write_json(paths.request, wanted)
    return jobs, study


def _described(request: Request) -> dict[str, Any]:
    """What must be the same where a sweep goes on."""
    if request.settings.sampler == "grid":
        return {"jobs": [dict(job.overrides) for job in request.jobs]}
    sampler = {"sampler": request.settings.sampler, "seed": request.settings.seed}
    return sampler | {"space": {key: list(values) for key, values in request.space.items()}}


def _announce(console: Console, plan: Plan, request: Request, jobs: Sequence[Job]) -> None:
    settings = request.settings
    total = len(request.jobs) if settings.sampler == "grid" else settings.trials
    done = sum(job.progress.state == "completed" for job in jobs)
    more = f", {done} of them complete already" if done else ""
    console.print(
        f"{total} jobs{more}, {len(plan.slices)} at a time on {plan.layout.num_gpus} GPUs, "
        f"backend {plan.backend}"
    )
    for reason in plan.reasons:
        console.print(f"  {reason}")
