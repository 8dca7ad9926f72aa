"""Runs jobs of any kind, as many at a time as there are slots."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Generic

from gmijax.clock import running_s
from gmijax.config.sweep import Ranking
from gmijax.errors import GmijaxError, JobInterrupted, JobNotStarted, NodeLost
from gmijax.runs.folder import add_event
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.any_job import J
from gmijax.sweeps.children import ChildStatus, errors_of_one_job
from gmijax.sweeps.held_jobs import HeldJobs
from gmijax.sweeps.host import ChildStart
from gmijax.sweeps.kind import Kind, Limiter
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.running import JobOutcome, Running
from gmijax.sweeps.slots import Slot, SlotPool
from gmijax.sweeps.study import Study

_TICK_S = 0.1
_KILLED_S = 15.0
"""For killed ones to be gone."""

_FIRST_REPORT_S = 120.0
"""Others that compile the same wait no longer for a first report."""


class Scheduler(Generic[J]):
    """Starts jobs in free slots, reads how far they are, and ends them on request.

    A job that fails, or cannot be started, ends alone. But where it shared an MPS daemon, and the
    fault may have been that of another client, it is run once more, from its last checkpoint and
    alone on its GPU. Jobs with other faults that may pass, such as a machine that is gone, run
    again, as often as their kind allows.

    Args:
      jobs: those that are known; those that are `waiting` are run.
      study: more jobs come from it; gets how jobs do.
      kind: of all jobs.
      ranking: what they are compared by.
      paths: their files.
      slots: of the jobs.
      hosts: machines of the slots, in that order; opened.
      on_tick: called ten times a second.
      limiter: changes how many run at once; None: as many as there are slots.
    """

    def __init__(
        self,
        jobs: list[J],
        study: Study[J],
        kind: Kind[J],
        ranking: Ranking,
        paths: SweepPaths,
        slots: SlotPool,
        hosts: Sequence[Host],
        on_tick: Callable[[], None],
        limiter: Limiter[J] | None = None,
    ) -> None:
        self._jobs, self._study = jobs, study
        self._queue = [job for job in jobs if job.progress.state == "waiting"]
        self._kind, self._ranking, self._paths = kind, ranking, paths
        self._slots, self._hosts, self._on_tick = slots, hosts, on_tick
        self._limiter = limiter
        self._held = HeldJobs(paths)
        self._alone: set[int] = set()
        self._faults: Counter[int] = Counter()
        self._running: dict[int, Running[J]] = {}
        self._compiling: dict[tuple[int, str], int | None] = {}
        self._write_error: OSError | None = None

    def run(self, signals: StopSignals) -> None:
        """Returns when all jobs have ended.

        Raises:
          JobInterrupted: a signal came; all jobs have saved and ended.
          ConfigError: jobs have not what they are to be compared by; all have saved and ended.
          NodeLost: no machine is left.
          GmijaxError, OSError: no job can be started, or the study not be written; all jobs have
            saved and ended.
        """
        try:
            self._start_what_fits()
            while self._queue or self._running:
                if signals.have_come:
                    raise JobInterrupted("interrupted")
                self._look()
                if self._write_error is not None:
                    raise self._write_error
                self._retract()
                if not self._slots.left:
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
            if job.progress.state != "waiting":
                continue  # Started together with one before it.
            if self._held.has(job) or self._start_if_it_fits(job):
                continue
            if not self._sites_to_avoid(job):
                return  # In order, so that a large job is not passed by forever.
        num_free = self._slots.num_gpus_with_free_slot
        while self._held.are_all(self._queue) and num_free() and (job := self._study.next()):
            self._jobs.append(job)
            if self._held.has(job) or not self._start_if_it_fits(job):
                self._queue.append(job)
        for job in () if self._running else self._queue:
            if (why := self._held.why_failed(job)) is not None:
                self._fail((job,), why)

    def _start_if_it_fits(self, job: J) -> bool:
        """Starts a job if there is a slot for it; whether it has left the queue."""
        avoid = self._sites_to_avoid(job)
        if not (num_gpus := self._slots.num_gpus_with_free_slot(avoid)):
            return False
        together = self._kind.together(job, self._queue, self._alone)
        slot = self._slots.acquire(
            job.num_gpus,
            alone=job.number in self._alone,
            avoid=avoid,
            num_jobs=-(-len(together) // num_gpus),  # So that every GPU gets its part of them.
        )
        if slot is None:
            return False
        started = together[: slot.size]
        try:
            self._start(started, slot)
        except NodeLost:
            self._drop_lost()
            return False
        except JobNotStarted as error:
            self._slots.release(slot)
            if len(started) > 1:  # It may be the fault of one of them.
                self._alone |= {one.number for one in started}
                return False
            self._fail(started, str(error))
        return True

    def _fail(self, jobs: tuple[J, ...], why: str) -> None:
        """Notes that jobs of the queue have failed before they could start."""
        for job in jobs:
            job.progress.state, job.progress.error = "failed", why
            self._close(job)
        self._queue = [job for job in self._queue if job.progress.state == "waiting"]

    def _sites_to_avoid(self, job: J) -> set[int]:
        """Machines where another job compiles the same, which is found in a cache later."""
        return {
            site
            for (site, program), number in self._compiling.items()
            if program == job.program and number is not None
        }

    def _start(self, jobs: tuple[J, ...], slot: Slot) -> None:
        host, first = self._hosts[slot.site], jobs[0]
        with errors_of_one_job():
            start = self._kind.start(jobs, slot)
        for job in jobs:
            job.progress.read(self._paths.job(job.number), self._ranking)
        child = host.start(ChildStart(slot, start.process))
        if start.is_awaited:
            self._compiling.setdefault((slot.site, first.program), first.number)
        self._running[first.number] = Running(jobs, slot, host, child, start.readers)
        for job in jobs:
            self._held.forget(job)
            job.progress.begin(slot.label, host.name)
        self._queue = [job for job in self._queue if job.progress.state == "waiting"]

    def _look(self) -> None:
        for running in list(self._running.values()):
            is_over = running.is_over()
            for job, reader in zip(running.jobs, running.readers, strict=True):
                for line in reader.new():
                    if not running.is_asked:
                        self._kind.require_ranked(line)
                    job.progress.report(line, self._ranking)
                    self._end_compile_wait(running)
            if running_s() > running.started_s + _FIRST_REPORT_S:
                self._end_compile_wait(running)
            if is_over:
                self._finish(running)
            elif running.is_asked:
                running.kill_if_late()
            elif self._is_hopeless(running.jobs[0]):
                running.is_pruned = True
                self._order_stop(running)
            elif (reason := self._kind.why_hung(running)) is not None:
                running.hang_reason = reason
                running.kill()
        self._drop_lost()

    def _retract(self) -> None:
        if self._limiter is not None:
            for running in self._limiter.look(list(self._running.values())):
                running.is_retracted = True
                self._order_stop(running)

    def _order_stop(self, running: Running[J], *, is_urgent: bool = True) -> None:
        limit_s = max(self._kind.stop_s(job, is_urgent=is_urgent) for job in running.jobs)
        running.order_stop(limit_s, is_urgent=is_urgent)

    def _finish(self, running: Running[J]) -> None:
        del self._running[running.jobs[0].number]
        ends = [self._kind.outcome(running, job) for job in running.jobs]
        exit_code = (running.look() or ChildStatus(None)).exit_code
        running.host.order(running.child_id, "close")
        self._slots.release(running.slot)
        self._end_compile_wait(running)
        again = [
            job
            for job, end in zip(running.jobs, ends, strict=True)
            if self._end(running, job, end, exit_code)
        ]
        # They came before the others; one that waits for a whole GPU must not hold them up.
        first = [job for job in again if job.number not in self._alone]
        rest = [job for job in again if job.number in self._alone]
        self._queue = [*first, *self._queue, *rest]

    def _end(self, running: Running[J], job: J, end: JobOutcome, exit_code: int | None) -> bool:
        """Notes how a job has ended; whether it is to run again."""
        run, progress = self._paths.job(job.number), job.progress
        progress.read(run, self._ranking)
        progress.slot, progress.error, progress.ended_s = "", end.error, time.monotonic()
        progress.exit_code = exit_code
        progress.state = "failed" if end.error else "completed"
        if (
            running.is_retracted
            and (end.is_interrupted or end.error)
            and not running.ended_by_shutdown
        ):
            progress.state, progress.error, progress.note = "waiting", None, None
            return True
        if end.is_interrupted or (end.is_fault and running.is_pruned):
            progress.state = "pruned" if running.is_pruned else "interrupted"
        elif end.error and (again := self._why_again(running, job, end)):
            progress.state, progress.error, progress.note = "waiting", again, None
            add_event(run.events, "again", reason=again)
            return True
        self._close(job)
        return False

    def _close(self, job: J) -> None:
        """A job has ended for good."""
        with suppress(OSError):  # A full disk must not end the sweep.
            self._kind.ended(job, self._paths.job(job.number))
        self._tell(job)

    def _is_hopeless(self, job: J) -> bool:
        try:
            return self._study.is_hopeless(job)
        except OSError as error:
            self._write_error = self._write_error or error
            return False

    def _tell(self, job: J) -> None:
        # Whatever becomes of the study, running jobs are to save and end.
        try:
            self._study.tell(job)
        except OSError as error:
            self._write_error = self._write_error or error

    def _why_again(self, running: Running[J], job: J, end: JobOutcome) -> str | None:
        """Why a job that failed runs once more, if that may help."""
        error, is_shared = end.error or "", not running.slot.is_alone
        if end.is_out_of_memory and self._limiter and self._limiter.forbid(running, error):
            return f"again, beside fewer others, after {error}"
        # The fault may be that of another client of its daemon.
        if end.may_be_neighbours and is_shared and running.host.lost is None:
            self._alone.add(job.number)
            return f"again, alone on its GPU, after {error}"
        if end.again is not None:
            return f"again, {end.again}, after {error}"
        if end.is_fault:
            self._faults[job.number] += 1
            # It may be what ends them.
            if self._faults[job.number] <= self._kind.max_restarts(job):
                return f"again, after {error}"
        return None

    def _end_compile_wait(self, running: Running[J]) -> None:
        """Its metrics are there, or it has ended, perhaps before it had compiled."""
        first = running.jobs[0]
        key = running.slot.site, first.program
        if self._compiling.get(key) == first.number:
            self._compiling[key] = None

    def _drop_lost(self) -> None:
        for site in list(self._slots.left):
            if self._hosts[site].lost is not None:
                self._slots.remove_site(site)

    def _stop(self, signals: StopSignals) -> None:
        """Asks all jobs to save and end; the same signal again ends them at once."""
        while signals.requests < 2 and not all(one.kill_sent for one in self._running.values()):
            # Ctrl-C may be followed by a signal that is in a hurry.
            is_urgent = signals.are_urgent or not signals.have_come
            for running in self._running.values():
                self._order_stop(running, is_urgent=is_urgent)
            self._look()
            self._on_tick()
            time.sleep(_TICK_S)

    def _kill_all(self) -> None:
        left = list(self._running.values())
        for running in left:
            running.ended_by_shutdown = True
            running.kill()
        deadline_s = running_s() + 2 * _KILLED_S
        for running in left:
            while not running.is_over() and running_s() < deadline_s:
                time.sleep(_TICK_S)
            self._finish(running)
