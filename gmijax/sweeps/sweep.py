"""The controller of a sweep: from jobs to a ranking. No jax here."""

from __future__ import annotations

import os
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
from gmijax.runs.folder import RUNS, create_run, given_run, read_json, write_json
from gmijax.runs.held import locked
from gmijax.supervise.run_gmis import StopSignals, stop_signals
from gmijax.sweeps.host import LocalHost
from gmijax.sweeps.jobs import (
    Job,
    SweepPaths,
    jobs_of,
    require_objective,
    require_placeable,
    state_of,
    why_not_comparable,
)
from gmijax.sweeps.jobs_per_gpu import with_jobs_per_gpu
from gmijax.sweeps.nodes import Host, nodes_of
from gmijax.sweeps.packs import require_packable
from gmijax.sweeps.places import Places, Site, places_of
from gmijax.sweeps.report import LiveReport, ranking, write_report
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.space import Space
from gmijax.sweeps.study import MakeJob, OptunaStudy, Study
from gmijax.sweeps.view import SweepView

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
        require_objective(request.jobs, request.settings)
        require_packable(request.settings, request.jobs)
        paths = _open(request.jobs)
        with locked(paths.lock, f"run.dir={paths.root}"):
            return _run(request, hosts, paths, console, started_s)


def _run(
    request: Request, hosts: Sequence[Host], paths: SweepPaths, console: Console, started_s: float
) -> SweepResult:
    """Runs the sweep of a folder that is locked, on machines where nothing is started yet."""
    settings = request.settings
    jobs, study = _beginning(request, paths)
    write_report("running", jobs, settings, paths, 0.0)
    console.print(f"sweep folder: {paths.root}")
    view = SweepView(console, jobs, settings)
    status = "failed"
    try:
        with stop_signals() as signals, ExitStack() as held:
            _lease(hosts, _sites(settings, request, hosts), console, signals)
            scratch = paths.root if hosts[0].name else None
            settings = with_jobs_per_gpu(settings, request.jobs, hosts, console, signals, scratch)
            sites = _sites(settings, request, hosts)
            _announce(console, sites, request, jobs)
            for number, (host, site) in enumerate(zip(hosts, sites, strict=True)):
                held.callback(host.shut)
                host.open(site.plan, paths.node(number) if host.name else paths)
            held.enter_context(view)
            live = LiveReport(jobs, settings, paths, started_s)

            def tick() -> None:
                live.update()
                view.update()

            Scheduler(jobs, study, settings, paths, Places(sites), hosts, tick).run(signals)
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


def _open(jobs: Sequence[Job]) -> SweepPaths:
    """The folder of the sweep, made if it is not there."""
    run = jobs[0].config.run
    folder = given_run(run.dir, run.name)
    if folder is None or not os.path.lexists(folder):
        return SweepPaths(create_run(run.dir, run.name, "sweep").root)
    if not folder.is_dir():
        raise ConfigError(f"run.dir={folder}: is no folder")
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


def _announce(
    console: Console, sites: Sequence[Site], request: Request, jobs: Sequence[Job]
) -> None:
    settings = request.settings
    total = len(request.jobs) if settings.sampler == "grid" else settings.trials
    done = sum(job.progress.state == "completed" for job in jobs)
    more = f", {done} of them complete already" if done else ""
    places = sum(len(site.plan.slices) for site in sites)
    gpus = sum(site.plan.layout.num_gpus for site in sites)
    nodes = f" of nodes {', '.join(site.name for site in sites if site.name)}"
    console.print(
        f"{total} jobs{more}, {places} at a time on {gpus} GPUs{nodes if sites[0].name else ''}, "
        f"backend {sites[0].plan.backend}"
    )
    for reason in dict.fromkeys(reason for site in sites for reason in site.plan.reasons):
        console.print(f"  {reason}")
    if (warning := why_not_comparable(request.jobs, settings)) is not None:
        console.print(f"  {warning}")
