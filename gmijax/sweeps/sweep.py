"""The controller of a sweep: from jobs to a ranking. No jax here."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.config import ClusterConfig, TrainConfig
from gmijax.config.schema import from_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import open_console
from gmijax.control.decide import with_task
from gmijax.errors import ConfigError, JobInterrupted, SweepFailed
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import RUNS, given_run, read_json, write_json
from gmijax.runs.held import OpenFolder, locked
from gmijax.supervise.run_gmis import StopSignals, stop_signals
from gmijax.sweeps.folder import errors_of_files, opened_folder
from gmijax.sweeps.host import LocalHost
from gmijax.sweeps.jobs import (
    Job,
    SweepPaths,
    jobs_of,
    require_placeable,
    state_of,
)
from gmijax.sweeps.jobs_per_gpu import with_jobs_per_gpu
from gmijax.sweeps.nodes import Host, nodes_of
from gmijax.sweeps.objective import with_objective
from gmijax.sweeps.packs import require_packable
from gmijax.sweeps.places import Places, Site, places_of
from gmijax.sweeps.report import Report
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.space import Space
from gmijax.sweeps.study import MakeJob, OptunaStudy, Study, optuna_package
from gmijax.sweeps.view import SweepView
from gmijax.sweeps.words import announce, print_outcome

_LEASE_POLL_S = 0.2


class Request(NamedTuple):
    """A sweep to be run.

    Attributes:
      settings: how jobs share the GPUs, and what they are compared by.
      space: what the keys of jobs may be.
      make_job: a job with values of the space.
      jobs: all of a grid; of another sampler some that stand for all, to be checked.
      cluster: the nodes that they run on; without an engine it is this machine.
    """

    settings: SweepConfig
    space: Space
    make_job: MakeJob
    jobs: tuple[Job, ...]
    cluster: ClusterConfig = ClusterConfig()


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

    Examples:
      >>> sweep([compose("env=ant", f"seed={seed}") for seed in range(4)], jobs_per_gpu=2)

    Args:
      configs: at least one; all with the same `run.dir` or `run.name`, the folder of the sweep,
        and the same `cluster`, whose nodes the jobs run on.
      show: print live progress and the ranking.
      settings: keys of `sweep.*`.

    Raises:
      ConfigError, SweepFailed, JobInterrupted: as `run_request`.
    """
    clusters = {config.cluster for config in configs}
    if len(clusters) > 1:
        raise ConfigError("cluster: a sweep has one; give all configurations the same")
    jobs = jobs_of([replace(config, cluster=ClusterConfig()) for config in configs])
    own = from_dict(SweepConfig, settings)
    request = Request(own, {}, lambda n, _: jobs[n], jobs, *clusters)
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
    console = open_console(show=show)
    request = _with_tasks(request)
    with _hosts_of(request) as hosts:
        # Before anything is started: whether there are such GPUs, and room for so many jobs.
        sites = _sites(request.settings, request, hosts)
        require_placeable(request.jobs, min(site.plan.layout.num_gpus for site in sites))
        request = request._replace(settings=with_objective(request.settings, request.jobs))
        require_packable(request.settings, request.jobs)
        if request.settings.sampler != "grid":
            optuna_package()
        with (
            opened_folder(request.jobs) as paths,
            locked(paths.lock, f"run.dir={paths.root}") as folder,
        ):
            return _run(request, hosts, paths, folder, console, started_s)


def _run(
    request: Request,
    hosts: Sequence[Host],
    paths: SweepPaths,
    folder: OpenFolder,
    console: Console,
    started_s: float,
) -> SweepResult:
    """Runs the sweep of a folder that is locked, on machines where nothing is started yet."""
    settings = request.settings
    with errors_of_files(paths):
        jobs, study = _beginning(request, paths)
        report = Report(jobs, settings, paths, folder, started_s)
        report.begin()
    console.print(f"sweep folder: {paths.root}")
    view = SweepView(console, jobs, settings)
    try:
        with errors_of_files(paths):
            _train(request, hosts, paths, console, study, report, view, jobs)
    except BaseException as error:
        status = "interrupted" if isinstance(error, JobInterrupted) else "failed"
        if (wrong := report.end(status)) is not None:
            error.add_note(wrong)
        if isinstance(error, JobInterrupted | SweepFailed):
            error.add_note(f"the same command with run.dir={paths.root} goes on")
        raise
    failed = [job for job in jobs if job.progress.state == "failed"]
    wrong = report.end("failed" if failed else "completed")
    print_outcome(console, report.data, settings, paths, view.line())
    if failed:
        first = failed[0]
        text = f"{len(failed)} of {len(jobs)} jobs failed; job {first.number}: "
        wrong = f"{text}{first.progress.error}{'' if wrong is None else f'; {wrong}'}"
    if wrong is not None:
        raise SweepFailed(wrong)
    return SweepResult(paths.root, report.data)


def _train(
    request: Request,
    hosts: Sequence[Host],
    paths: SweepPaths,
    console: Console,
    study: Study,
    report: Report,
    view: SweepView,
    jobs: list[Job],
) -> None:
    """Runs the jobs; returns when all have ended."""
    settings = request.settings
    with stop_signals() as signals, ExitStack() as held:
        _lease(hosts, _sites(settings, request, hosts), console, signals)
        scratch = paths.root if hosts[0].name else None
        settings = with_jobs_per_gpu(settings, request.jobs, hosts, console, signals, scratch)
        sites = _sites(settings, request, hosts)
        num_complete = sum(job.progress.state == "completed" for job in jobs)
        announce(console, sites, request.jobs, settings, num_complete)
        for number, (host, site) in enumerate(zip(hosts, sites, strict=True)):
            held.callback(host.shut)
            host.open(site.plan, paths.node(number) if host.name else paths)
        held.enter_context(view)

        def tick() -> None:
            report.update()
            view.update()

        Scheduler(jobs, study, settings, paths, Places(sites), hosts, tick).run(signals)


@contextmanager
def _hosts_of(request: Request) -> Iterator[Sequence[Host]]:
    """The machines of a sweep while it is entered: nodes of its cluster, or this one."""
    if request.cluster.engine is not None:
        run = request.jobs[0].config.run
        root = given_run(run.dir, run.name) or RUNS
        with nodes_of(request.cluster, request.settings, request.jobs, root) as nodes:
            yield nodes
        return
    with closing(LocalHost(detect_machine())) as host:
        yield [host]


def _sites(settings: SweepConfig, request: Request, hosts: Sequence[Host]) -> list[Site]:
    backends = {job.config.plan.backend for job in request.jobs}
    plans = [places_of(settings, host.machine, backends) for host in hosts]
    return [Site(plan, host.machine, host.name) for plan, host in zip(plans, hosts, strict=True)]


def _lease(
    hosts: Sequence[Host], sites: Sequence[Site], console: Console, signals: StopSignals
) -> None:
    """Holds the GPUs of all places; waits for those that another sweep has.

    Raises:
      JobInterrupted: a signal came.
    """
    # In one order, so that two sweeps do not wait for each other.
    for host, site in sorted(zip(hosts, sites, strict=True), key=lambda both: both[0].name or ""):
        devices = {share.device for share in site.plan.slices} - {"cpu"}
        told = None
        while (other := host.lease(devices)) is not None:
            if other != told:
                console.print(f"another sweep has {other}: waiting until it ends")
            if signals.have_come:
                raise JobInterrupted("interrupted")
            told = other
            time.sleep(_LEASE_POLL_S)


def _with_tasks(request: Request) -> Request:
    """The request with the tasks of all jobs pinned, also of those that are still to be made."""

    def pinned(job: Job) -> Job:
        return replace(job, config=with_task(job.config))

    return request._replace(
        jobs=tuple(map(pinned, request.jobs)),
        make_job=lambda number, chosen: pinned(request.make_job(number, chosen)),
    )


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
    study = Study()
    jobs = list(request.jobs)
    if settings.sampler != "grid":
        study = OptunaStudy(settings, request.space, request.make_job, paths.study)
        jobs = study.earlier()
    for job in jobs:
        run = paths.job(job.number)
        job.progress.read(run, settings)
        if job.progress.state != "pruned":
            job.progress.state = state_of(run, job.config)
        if job.progress.state == "completed":
            wall_s = read_json(run.summary).get("wall_s")
            job.progress.earlier_s = wall_s if isinstance(wall_s, float) else 0.0
    write_json(paths.request, wanted)
    return jobs, study


def _described(request: Request) -> dict[str, Any]:
    """What must be the same where a sweep goes on."""
    if request.settings.sampler == "grid":
        return {"jobs": [dict(job.overrides) for job in request.jobs]}
    sampler = {"sampler": request.settings.sampler, "seed": request.settings.seed}
    return sampler | {"space": {key: list(values) for key, values in request.space.items()}}
