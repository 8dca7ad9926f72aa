"""The controller of a sweep or a pack: from jobs to a ranking."""

from __future__ import annotations

import json
import os
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from rich.console import Console

from gmijax.control.console import Show, nearby, open_console, print_next
from gmijax.errors import ConfigError, JobInterrupted, SweepFailed
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import RUNS, given_run, read_json, write_json
from gmijax.runs.held import OpenFolder, locked
from gmijax.supervise.stop_signals import StopSignals, stop_signals
from gmijax.sweeps.any_job import J
from gmijax.sweeps.events import JobEvents
from gmijax.sweeps.folder import errors_of_files, opened_folder, require_folders
from gmijax.sweeps.held_jobs import left_behind
from gmijax.sweeps.host import LocalHost
from gmijax.sweeps.nodes import Host, nodes_of
from gmijax.sweeps.paths import ENV_PACK_DIR, SweepPaths
from gmijax.sweeps.report import JobsReport
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.slots import Site, SlotPool
from gmijax.sweeps.study import OptunaStudy, Study, optuna_package
from gmijax.sweeps.view import SweepView
from gmijax.sweeps.words import announce, print_outcome
from gmijax.sweeps.work import Work, name_of_request

_LEASE_POLL_S = 0.2


class SweepResult(NamedTuple):
    """Result of a sweep or a pack.

    Attributes:
      root: its folder.
      report: the content of its `sweep.json` or `pack.json`.
    """

    root: Path
    report: dict[str, Any]


def run_work(work: Work[J], *, show: Show = False, events: TextIO | None = None) -> SweepResult:
    """Runs all jobs, as many at a time as the settings allow, and compares them.

    Called again with the same work and folder, it runs those that are not complete.

    Args:
      work: the jobs.
      show: print live progress and the ranking.
      events: gets a JSON object a line for each event, see `JobEvents`.

    Raises:
      ConfigError: bad input, before anything was started; or jobs have not what they are to be
        compared by, and have saved and ended.
      SweepFailed: a job failed; all others have run.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came, and all jobs have saved and ended.
    """
    started_s = time.monotonic()
    console = open_console(show=show)
    with _hosts_of(work) as hosts:
        # Before anything is started: whether there are such GPUs, and slots for so many jobs.
        work.require_runnable(work.sites(hosts))
        if work.settings.sampler != "grid":
            optuna_package()
        with (
            opened_folder(work) as paths,
            locked(paths.lock, f"run.dir={nearby(paths.root)}") as folder,
        ):
            return _run(work, hosts, paths, folder, console, started_s, events)


def _run(
    work: Work[J],
    hosts: Sequence[Host],
    paths: SweepPaths,
    folder: OpenFolder,
    console: Console,
    started_s: float,
    events: TextIO | None,
) -> SweepResult:
    """Runs the jobs in a folder that is locked, on machines where nothing is started yet."""
    with errors_of_files(paths):
        jobs, study = _beginning(work, paths, console)
        report = JobsReport(jobs, work.ranking, work.described, paths, folder, started_s)
        report.begin()
    console.print(f"{work.name} folder: {nearby(paths.root)}")
    view = SweepView(console, jobs, work.ranking, work.stopping)
    job_events = JobEvents(events, work.name, jobs, paths)
    try:
        with errors_of_files(paths):
            hinted = _run_jobs(work, hosts, paths, console, study, report, view, jobs, job_events)
    except BaseException as error:
        status = "interrupted" if isinstance(error, JobInterrupted) else "failed"
        if (wrong := report.end(status)) is not None:
            error.add_note(wrong)
        job_events.end(report.data)
        for left in left_behind(jobs, paths, [one for host in hosts for one in host.left]):
            error.add_note(left)
        _say_how_to_continue(error, work, jobs, paths)
        raise
    failed = [job for job in jobs if job.progress.state == "failed"]
    wrong = report.end("failed" if failed else "completed")
    job_events.end(report.data)
    hint = "" if hinted else work.hint(report.data)
    print_outcome(console, report.data, work.ranking, paths, view.line(), hint)
    _require_success(failed, len(jobs), wrong, paths)
    if ranking := report.data["ranking"]:
        print_next(console, work.next_step(paths, ranking[0]))
    return SweepResult(paths.root, report.data)


def _say_how_to_continue(
    error: BaseException, work: Work[J], jobs: Sequence[J], paths: SweepPaths
) -> None:
    folder = shlex.quote(f"run.dir={nearby(paths.root)}")
    if isinstance(error, JobInterrupted | SweepFailed):
        # The folder first: what follows `--` is the program's.
        command = f"the same command with {folder}"
        if work.words:
            command = f"gmijax {work.name} {folder} {shlex.join(work.words)}"
        error.add_note(f"to continue: {command}")
    elif isinstance(error, ConfigError) and any(job.progress.attempts for job in jobs):
        error.add_note(f"to continue: the command with that mended and {folder}")


def _require_success(
    failed: Sequence[J], num_jobs: int, wrong: str | None, paths: SweepPaths
) -> None:
    """Raises SweepFailed for jobs that have failed, and for what else is `wrong`."""
    if failed:
        first = failed[0]
        log = paths.log(first.number)
        text = f"{len(failed)} of {num_jobs} jobs failed; job {first.number}: "
        text += f"{first.progress.error}{f' (log: {nearby(log)})' if log.exists() else ''}"
        wrong = text if wrong is None else f"{text}; {wrong}"
    if wrong is not None:
        raise SweepFailed(wrong)


def _run_jobs(
    work: Work[J],
    hosts: Sequence[Host],
    paths: SweepPaths,
    console: Console,
    study: Study[J],
    report: JobsReport,
    view: SweepView,
    jobs: list[J],
    job_events: JobEvents,
) -> bool:
    """Runs the jobs; returns when all have ended, whether a hint was printed meanwhile."""
    with stop_signals() as signals, ExitStack() as held:
        _lease(work, hosts, work.sites(hosts), console, signals)
        work = work.decided(hosts, console, signals, paths.root if hosts[0].name else None)
        sites = work.sites(hosts)
        num_complete = sum(job.progress.state == "completed" for job in jobs)
        announce(console, sites, work, num_complete)
        for number, (host, site) in enumerate(zip(hosts, sites, strict=True)):
            held.callback(host.shut)
            host.open(site.plan, paths.node(number) if host.name else paths)
        held.enter_context(view)
        slots = SlotPool(sites)
        limiter = work.limiter(slots, sites, hosts, console)

        hinted: list[str] = []

        def tick() -> None:
            report.update()
            if not hinted and (hint := work.hint(report.data)):
                hinted.append(hint)
                console.print(hint)
            view.update(signals.name)
            job_events.update()

        Scheduler(
            jobs,
            study,
            work.kind(paths, sites),
            work.ranking,
            paths,
            slots,
            hosts,
            tick,
            limiter,
        ).run(signals)
    if not jobs:
        raise ConfigError(f"{work.name}: no trial had values that are allowed together")
    return bool(hinted)


@contextmanager
def _hosts_of(work: Work[J]) -> Iterator[Sequence[Host]]:
    """The machines of the jobs while it is entered: nodes of their cluster, or this one."""
    if work.cluster.engine is not None:
        root = given_run(*work.folder) or RUNS
        with nodes_of(work.cluster, work.settings, work.on_cpu, work.processes, root) as nodes:
            yield nodes
        return
    with closing(LocalHost(detect_machine())) as host:
        yield [host]


def _lease(
    work: Work[J],
    hosts: Sequence[Host],
    sites: Sequence[Site],
    console: Console,
    signals: StopSignals,
) -> None:
    """Holds the GPUs of all slots; waits for those that another sweep has.

    Raises:
      ConfigError: this is a job of the pack that has them, and would wait for its own end.
      JobInterrupted: a signal came.
    """
    # In one order, so that two sweeps do not wait for each other.
    for host, site in sorted(zip(hosts, sites, strict=True), key=lambda both: both[0].name or ""):
        devices = {allocation.device for allocation in site.plan.allocations} - {"cpu"}
        announced = None
        while (other := host.lease(devices)) is not None:
            if (pack := os.environ.get(ENV_PACK_DIR)) is not None:
                raise ConfigError(
                    f"gmijax {work.name} cannot be a job of a pack: this one belongs to "
                    f"{nearby(Path(pack))}, which holds the GPU already; use gmijax train in it"
                )
            if other != announced:
                console.print(f"another {work.name} has {other}: waiting until it ends")
            if signals.have_come:
                raise JobInterrupted("interrupted")
            announced = other
            time.sleep(_LEASE_POLL_S)


def _beginning(work: Work[J], paths: SweepPaths, console: Console) -> tuple[list[J], Study[J]]:
    """The jobs that are known, as far as an earlier command has come, and where more come from.

    Raises:
      ConfigError: the folder holds others, or a package is missing.
    """
    settings, wanted = work.settings, json.loads(json.dumps(work.identity()))
    _require_same(work, wanted, paths)
    study = Study[J]()
    jobs = list(work.jobs)
    if settings.sampler != "grid":
        study = OptunaStudy(settings, work.space, work.make_job, paths.study, console.print)
        jobs = study.earlier()
    require_folders(paths, [job.number for job in jobs])
    for job in jobs:
        run = paths.job(job.number)
        job.progress.read(run, work.ranking)
        if job.progress.state != "pruned":
            job.progress.state = work.state_of(run, job)
        if job.progress.state == "completed":
            job.progress.take_summary(read_json(run.summary))
    write_json(paths.request, wanted)
    return jobs, study


def _require_same(work: Work[J], wanted: Mapping[str, Any], paths: SweepPaths) -> None:
    """Raises ConfigError if a folder holds other jobs, or has no record of which it holds."""
    if not paths.request.exists():
        return
    elsewhere = "give another folder"
    try:
        held = read_json(paths.request)
    except ConfigError as error:
        raise ConfigError(f"{error}; {elsewhere}") from None
    if (name := name_of_request(held)) is None:
        broken = f"{nearby(paths.request)}: broken (not what a sweep or a pack was asked)"
        raise ConfigError(f"{broken}; {elsewhere}")
    if name != work.name:
        raise ConfigError(f"run.dir={nearby(paths.root)}: holds a {name}; {elsewhere}")
    if held != wanted:
        raise ConfigError(
            f"run.dir={nearby(paths.root)}: holds another {name}; give the same "
            f"{work.resume_requirement}, or another folder"
        )
