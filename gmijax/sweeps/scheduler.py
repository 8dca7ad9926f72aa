"""Runs the jobs of a sweep, as many at a time as there are places."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from gmijax.clock import running_s
from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import GmijaxError, JobInterrupted, NodeLost
from gmijax.runs.folder import add_event
from gmijax.runs.held import is_locked
from gmijax.runs.history import MetricsReader
from gmijax.supervise.failures import may_be_anothers
from gmijax.supervise.run_gmis import StopSignals
from gmijax.sweeps.host import Start
from gmijax.sweeps.hparams import write_hparams
from gmijax.sweeps.jobs import Job, SweepPaths, placed
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import Packer, program_of
from gmijax.sweeps.places import Place, Places
from gmijax.sweeps.running import Outcome, Running
from gmijax.sweeps.study import Study

_TICK_S = 0.1
_KILL_AFTER_S = 15.0
"""Beyond what a job gives its GMIs to save and end; for killed ones to be gone."""


class Scheduler:
    """Starts jobs where there is room, reads how far they are, and ends them when told to.

    A job that fails ends alone. But where it shared an MPS daemon, and the fault may have been
    that of another client, it is run once more, from its last checkpoint and alone on its GPU.
    Jobs whose controller was killed, or of a machine that is gone, or of a process that they
    shared, run again, as often as `run.max_restarts` says.

    Args:
      jobs: those that are known; those that are `waiting` are run. More come from the study.
      study: see above; is told how jobs do.
      sweep: settings.
      paths: files of the sweep.
      places: of the jobs.
      hosts: machines of the places, in that order; opened.
      on_tick: called ten times a second.
    """

    def __init__(
        self,
        jobs: list[Job],
        study: Study,
        sweep: SweepConfig,
        paths: SweepPaths,
        places: Places,
        hosts: Sequence[Host],
        on_tick: Callable[[], None],
    ) -> None:
        self._jobs, self._study = jobs, study
        self._queue = [job for job in jobs if job.progress.state == "waiting"]
        self._sweep, self._paths = sweep, paths
        self._places, self._hosts, self._on_tick = places, hosts, on_tick
        self._packer = Packer(sweep, paths)
        self._alone: set[int] = set()
        self._faults: Counter[int] = Counter()
        self._running: dict[int, Running] = {}
        self._compiling: dict[tuple[int, str], int] = {}
        self._unwritten: OSError | None = None

    def run(self, signals: StopSignals) -> None:
        """Returns when all jobs have ended.

        Raises:
          JobInterrupted: a signal came; all jobs have saved and ended.
          NodeLost: no machine is left.
          GmijaxError, OSError: a job cannot be started, or the study not be written; all jobs have
            saved and ended.
        """
        try:
            self._start_what_fits()
            while self._queue or self._running:
                if signals.have_come:
                    raise JobInterrupted("interrupted")
                self._look()
                if self._unwritten is not None:
                    raise self._unwritten
                if not self._places.left:
                    raise NodeLost(f"no node is left: {self._hosts[-1].lost}")
                self._start_what_fits()
                self._on_tick()
                time.sleep(_TICK_S)
        except (GmijaxError, OSError):
            self._stop(signals)
            raise
        finally:
            self._kill_all()
            for job in self._queue:
                self._tell(job)

    def _start_what_fits(self) -> None:
        for job in list(self._queue):
            # A killed process of the job, or one of a machine that is gone, may still save.
            if is_locked(self._paths.job(job.number).lock):
                continue
            if job.progress.state != "waiting" or self._start_if_it_fits(job):
                continue
            if not self._compiling_sites(job):
                return  # In order, so that a large job is not passed by forever.
        while not self._queue and self._places.has_room() and (job := self._study.next()):
            self._jobs.append(job)
            if not self._start_if_it_fits(job):
                self._queue.append(job)

    def _start_if_it_fits(self, job: Job) -> bool:
        avoid = self._compiling_sites(job)
        # Others compile the same there; when they have, it is found in the cache.
        if not (num_gpus := self._places.num_gpus_with_room(avoid)):
            return False
        together = self._packer.together(job, self._queue, self._alone)
        place = self._places.take(
            job.num_gpus,
            alone=job.number in self._alone,
            avoid=avoid,
            num_jobs=-(-len(together) // num_gpus),  # So that every GPU gets its part of them.
        )
        if place is None:
            return False
        try:
            self._start(together[: place.size], place)
        except NodeLost:
            self._drop_lost()
            return False
        return True

    def _compiling_sites(self, job: Job) -> set[int]:
        """Machines where another job compiles the same programs."""
        return {site for site, program in self._compiling if program == job.program}

    def _start(self, jobs: tuple[Job, ...], place: Place) -> None:
        host, first = self._hosts[place.site], jobs[0]
        # Alone on a GPU a job does as it would without a sweep.
        backend = "auto" if place.is_whole_gpu else place.backend
        configs: list[dict[str, Any]] = []
        readers: list[MetricsReader] = []
        for job in jobs:
            run = self._paths.job(job.number)
            configs.append(to_dict(placed(job, run, place, backend)))
            readers.append(MetricsReader(run.metrics))
            job.progress.read(run, self._sweep)
            readers[-1].new()  # Those are an earlier attempt's.
        files = self._paths.order(first.number), self._paths.log(first.number)
        started = host.start(Start(place, configs, *files, program_of(first, len(jobs))))
        if not started.has_programs:
            self._compiling[place.site, first.program] = first.number
        self._running[first.number] = Running(jobs, place, host, started.child, tuple(readers))
        for job in jobs:
            job.progress.begin(place.label, host.name)
        self._queue = [job for job in self._queue if job.progress.state == "waiting"]

    def _look(self) -> None:
        for running in list(self._running.values()):
            is_over = running.is_over()
            for job, reader in zip(running.jobs, running.readers, strict=True):
                progress = job.progress
                for line in reader.new():
                    progress.take(line, self._sweep)
                    progress.updated_s = progress.updated_s or time.monotonic()
                    self._nobody_waits_for(running, has_compiled=True)
            if is_over:
                self._finish(running)
            elif not running.is_asked and self._is_hopeless(running.jobs[0]):
                running.is_pruned = True
                running.order_stop()
        self._drop_lost()

    def _finish(self, running: Running) -> None:
        del self._running[running.jobs[0].number]
        ends = [running.outcome(job, self._paths.job(job.number)) for job in running.jobs]
        running.host.order(running.child, "close")
        self._places.give_back(running.place)
        self._nobody_waits_for(running, has_compiled=False)
        again = [
            job
            for job, end in zip(running.jobs, ends, strict=True)
            if self._end(running, job, end)
        ]
        # They came before the others; one that waits for a whole GPU must not hold them up.
        first = [job for job in again if job.number not in self._alone]
        rest = [job for job in again if job.number in self._alone]
        self._queue = [*first, *self._queue, *rest]

    def _end(self, running: Running, job: Job, end: Outcome) -> bool:
        """Notes how a job has ended; whether it is to run again."""
        run, progress = self._paths.job(job.number), job.progress
        self._packer.forget(job)
        progress.read(run, self._sweep)
        progress.place, progress.error, progress.ended_s = "", end.error, time.monotonic()
        progress.state = "failed" if end.error else "completed"
        if end.is_interrupted or (end.is_fault and running.is_pruned):
            progress.state = "pruned" if running.is_pruned else "interrupted"
        elif end.error and (again := self._why_again(running, job, end)):
            progress.state, progress.error = "waiting", again
            add_event(run.events, "again", reason=again)
            return True
        with suppress(OSError):  # A full disk must not end the sweep.
            write_hparams(job, run, self._sweep.objective)
        self._tell(job)
        return False

    def _is_hopeless(self, job: Job) -> bool:
        try:
            return self._study.is_hopeless(job)
        except OSError as error:
            self._unwritten = self._unwritten or error
            return False

    def _tell(self, job: Job) -> None:
        # Whatever becomes of the study, running jobs are to save and end.
        try:
            self._study.tell(job)
        except OSError as error:
            self._unwritten = self._unwritten or error

    def _why_again(self, running: Running, job: Job, end: Outcome) -> str | None:
        """Why a job that failed runs once more, if that may help."""
        place, max_restarts = running.place, job.config.run.max_restarts
        error = end.error or ""
        # The fault may be that of another client of its daemon.
        has_neighbours = place.backend in ("mps", "mig") and not place.is_alone
        if (
            has_neighbours
            and max_restarts
            and running.host.lost is None
            and may_be_anothers(error)
        ):
            self._alone.add(job.number)
            return f"again, alone on its GPU, after {error}"
        if end.is_fault:
            self._faults[job.number] += 1
            # It may be what ends them.
            if self._faults[job.number] <= max_restarts:
                return f"again, after {error}"
        return None

    def _nobody_waits_for(self, running: Running, *, has_compiled: bool) -> None:
        """Its metrics are there, or it has ended, perhaps before it had compiled."""
        first, count = running.jobs[0], len(running.jobs)
        key = running.place.site, first.program
        if self._compiling.get(key) == first.number:
            del self._compiling[key]
            with suppress(NodeLost):
                running.host.add_program(program_of(first, count), has_compiled)

    def _drop_lost(self) -> None:
        for site in list(self._places.left):
            if self._hosts[site].lost is not None:
                self._places.drop(site)

    def _stop(self, signals: StopSignals) -> None:
        """Asks all jobs to save and end; the same signal again ends them at once."""
        for running in self._running.values():
            running.order_stop()
        limits = [running.jobs[0].config.run for running in self._running.values()]
        longest_s = max((run.stop_timeout_s + run.grace_s for run in limits), default=0.0)
        deadline_s = running_s() + longest_s + _KILL_AFTER_S
        while self._running and running_s() < deadline_s and signals.requests < 2:
            self._look()
            self._on_tick()
            time.sleep(_TICK_S)

    def _kill_all(self) -> None:
        left = list(self._running.values())
        for running in left:
            running.is_killed = True
            running.host.order(running.child, "kill")
        deadline_s = running_s() + 2 * _KILL_AFTER_S
        for running in left:
            while not running.is_over() and running_s() < deadline_s:
                time.sleep(_TICK_S)
            self._finish(running)
