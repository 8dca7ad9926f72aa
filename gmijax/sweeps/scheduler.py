"""Runs the jobs of a sweep, as many at a time as there are places."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.exit_codes import EXIT_INTERRUPTED
from gmijax.errors import JobInterrupted, NodeLost
from gmijax.runs.folder import RunPaths, add_event, is_locked
from gmijax.runs.history import MetricsReader
from gmijax.supervise.failures import may_be_anothers
from gmijax.supervise.run_gmis import StopSignals
from gmijax.sweeps.children import Seen
from gmijax.sweeps.host import Start
from gmijax.sweeps.hparams import write_hparams
from gmijax.sweeps.jobs import Job, SweepPaths, placed, status_of
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import may_share, of_one_step, program_of
from gmijax.sweeps.places import Place, Places
from gmijax.sweeps.study import Study

_TICK_S = 0.1
_KILL_AFTER_S = 15.0
"""Beyond what a job gives its GMIs to save and end; for killed ones to be gone."""


@dataclass
class _Running:
    """A process of jobs that runs: of one, or of several that are trained together.

    Attributes:
      jobs: what it trains.
      place: where.
      host: the machine.
      child: its number there.
      readers: of their metrics.
      is_pruned: whether it was asked to end because others are better.
      is_killed: whether it was ended by force, as the whole sweep is.
    """

    jobs: tuple[Job, ...]
    place: Place
    host: Host
    child: int
    readers: tuple[MetricsReader, ...]
    is_pruned: bool = False
    is_killed: bool = False

    def look(self) -> Seen | None:
        """How it is; None: that is not known."""
        return self.host.look(self.child)

    def order_stop(self) -> None:
        """Asks it to save and end."""
        self.host.order(self.child, "ask_to_stop")

    def is_over(self) -> bool:
        """Whether it has ended, or its machine is gone."""
        seen = self.look()
        return self.host.lost is not None or (seen is not None and seen.exit_code is not None)

    def outcome(self, run: RunPaths) -> tuple[bool, str | None]:
        """After its end, of the job with this run folder.

        Returns:
          Whether it was interrupted, and why it failed (None: it did not).
        """
        seen = self.look() or Seen(None)
        is_complete = len(self.jobs) > 1 and status_of(run) == "completed"
        if seen.exit_code == 0 or is_complete:
            return False, None
        if seen.exit_code == EXIT_INTERRUPTED or self.is_killed:
            return True, None
        if seen.exit_code is None:
            return False, self.host.lost
        return False, seen.said.removeprefix("gmijax.train: ") or f"exit code {seen.exit_code}"


class Scheduler:
    """Starts jobs where there is room, reads how far they are, and ends them when told to.

    A job that fails ends alone. But where it shared an MPS daemon, and the fault may have been
    that of another client, it is run once more, from its last checkpoint and alone on its GPU.
    Jobs of a machine that is gone run again on others, as often as `run.max_restarts` says.

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
        self._alone: set[int] = set()
        self._nodes_lost: Counter[int] = Counter()
        self._running: dict[int, _Running] = {}
        self._compiling: dict[tuple[int, str], int] = {}

    def run(self, signals: StopSignals) -> None:
        """Returns when all jobs have ended.

        Raises:
          JobInterrupted: a signal came; all jobs have saved and ended.
          NodeLost: no machine is left.
        """
        try:
            self._start_what_fits()
            while self._queue or self._running:
                if signals.have_come:
                    self._stop(signals)
                    raise JobInterrupted("interrupted")
                self._look()
                if not self._places.left:
                    raise NodeLost(f"no node is left: {self._hosts[-1].lost}")
                self._start_what_fits()
                self._on_tick()
                time.sleep(_TICK_S)
        finally:
            self._kill_all()

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
        if not self._places.has_room():
            return False
        # Others compile the same there; when they have, it is found in the cache.
        avoid, together = self._compiling_sites(job), self._together(job)
        place = self._places.take(
            job.num_gpus,
            alone=job.number in self._alone,
            avoid=avoid,
            num_jobs=len(together),
        )
        if place is None:
            return False
        try:
            self._start(together[: place.size], place)
        except NodeLost:
            self._drop_lost()
            return False
        return True

    def _together(self, job: Job) -> tuple[Job, ...]:
        """The job, and those in the queue that can be trained in one program with it."""
        if self._sweep.pack == "gmi" or job.number in self._alone:
            return (job,)
        others = [
            other
            for other in self._queue
            if other.number not in (job.number, *self._alone) and may_share(job, other)
        ]
        free = [one for one in others if not is_locked(self._paths.job(one.number).lock)]
        return (job, *of_one_step(job, free, self._paths))

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
        self._running[first.number] = _Running(jobs, place, host, started.child, tuple(readers))
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
            elif not running.is_pruned and self._study.is_hopeless(running.jobs[0]):
                running.is_pruned = True
                running.order_stop()
        self._drop_lost()

    def _finish(self, running: _Running) -> None:
        del self._running[running.jobs[0].number]
        outcomes = [running.outcome(self._paths.job(job.number)) for job in running.jobs]
        running.host.order(running.child, "close")
        self._places.give_back(running.place)
        self._nobody_waits_for(running, has_compiled=False)
        for job, (is_interrupted, error) in zip(running.jobs, outcomes, strict=True):
            self._end(running, job, error, is_interrupted=is_interrupted)

    def _end(
        self, running: _Running, job: Job, error: str | None, *, is_interrupted: bool
    ) -> None:
        """Notes how a job has ended, or puts it back into the queue."""
        run, progress = self._paths.job(job.number), job.progress
        is_lost = error is not None and error == running.host.lost
        progress.read(run, self._sweep)
        progress.place, progress.error, progress.ended_s = "", error, time.monotonic()
        progress.state = "failed" if error else "completed"
        if is_interrupted or (is_lost and running.is_pruned):
            progress.state = "pruned" if running.is_pruned else "interrupted"
        elif error and (again := self._why_again(running, job, error, is_lost=is_lost)):
            # It came before the others; one that waits for a whole GPU must not hold them up.
            self._queue.insert(0 if is_lost else len(self._queue), job)
            progress.state, progress.error = "waiting", again
            add_event(run.events, "again", reason=again)
            return
        with suppress(OSError):  # A full disk must not end the sweep.
            write_hparams(job, run, self._sweep.objective)
        self._study.tell(job)

    def _why_again(self, running: _Running, job: Job, error: str, *, is_lost: bool) -> str | None:
        """Why a job that failed runs once more, if that may help."""
        if is_lost:
            self._nodes_lost[job.number] += 1
            # It may be what ends them.
            is_allowed = self._nodes_lost[job.number] <= job.config.run.max_restarts
            return f"again, after {error}" if is_allowed else None
        # The fault may be that of another client of its daemon.
        has_daemon = running.place.backend in ("mps", "mig")
        may_restart = job.config.run.max_restarts > 0 and job.number not in self._alone
        if has_daemon and may_restart and may_be_anothers(error):
            self._alone.add(job.number)
            return f"again, alone on its GPU, after {error}"
        return None

    def _nobody_waits_for(self, running: _Running, *, has_compiled: bool) -> None:
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
        deadline_s = time.monotonic() + longest_s + _KILL_AFTER_S
        while self._running and time.monotonic() < deadline_s and signals.requests < 2:
            self._look()
            self._on_tick()
            time.sleep(_TICK_S)

    def _kill_all(self) -> None:
        left = list(self._running.values())
        for running in left:
            running.is_killed = True
            running.host.order(running.child, "kill")
        deadline_s = time.monotonic() + 2 * _KILL_AFTER_S
        for running in left:
            while not running.is_over() and time.monotonic() < deadline_s:
                time.sleep(_TICK_S)
            self._finish(running)
