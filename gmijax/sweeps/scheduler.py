"""Runs the jobs of a sweep, as many at a time as there are places."""

from __future__ import annotations

import time
from collections.abc import Callable

from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import JobInterrupted
from gmijax.machine.mps_control import PIPE_VARIABLE
from gmijax.machine.processes import members_of, wait_until_gone
from gmijax.partition.plan import Plan
from gmijax.runs.folder import is_locked
from gmijax.runs.history import MetricsReader
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.launcher import StopSignals
from gmijax.sweeps.children import Child, start
from gmijax.sweeps.jobs import Job, SweepPaths, placed
from gmijax.sweeps.places import Place, Places
from gmijax.sweeps.study import Study

_TICK_S = 0.1
_KILL_AFTER_S = 15.0
"""Beyond what a job gives its GMIs to save and end."""


class Scheduler:
    """Starts jobs where there is room, reads how far they are, and ends them when told to.

    Args:
      jobs: those that are known; those that are `waiting` are run. More come from the study.
      study: see above; is told how jobs do.
      sweep: settings.
      paths: files of the sweep.
      plan: its slices are the places of the jobs.
      backend: of the plan, entered.
      on_tick: called ten times a second.
    """

    def __init__(
        self,
        jobs: list[Job],
        study: Study,
        sweep: SweepConfig,
        paths: SweepPaths,
        plan: Plan,
        backend: Backend,
        on_tick: Callable[[], None],
    ) -> None:
        self._jobs, self._study = jobs, study
        self._queue = [job for job in jobs if job.progress.state == "waiting"]
        self._sweep, self._paths = sweep, paths
        self._plan, self._backend, self._on_tick = plan, backend, on_tick
        self._places = Places(plan.slices)
        self._running: dict[int, Child] = {}
        self._readers: dict[int, MetricsReader] = {}
        self._compiled: set[str] = set()
        self._compiling: dict[str, int] = {}

    def run(self, signals: StopSignals) -> None:
        """Returns when all jobs have ended.

        Raises:
          JobInterrupted: a signal came; all jobs have saved and ended.
        """
        try:
            self._start_what_fits()
            while self._queue or self._running:
                if signals.have_come:
                    self._stop(signals)
                    raise JobInterrupted("interrupted")
                self._look()
                self._start_what_fits()
                self._on_tick()
                time.sleep(_TICK_S)
        finally:
            self._kill_all()

    def _start_what_fits(self) -> None:
        for job in list(self._queue):
            # The others would compile the same; when it has, they find it in the cache.
            if self._compiling.get(job.program, job.number) != job.number:
                continue
            # A killed sweep's process of the job may still save.
            if is_locked(self._paths.job(job.number).lock):
                continue
            if not self._start_if_it_fits(job):
                return  # In order, so that a large job is not passed by forever.
            self._queue.remove(job)
        while not self._queue and self._places.has_room() and (job := self._study.next()):
            self._jobs.append(job)
            if not self._start_if_it_fits(job):
                self._queue.append(job)

    def _start_if_it_fits(self, job: Job) -> bool:
        place = self._places.take(job.num_gpus)
        if place is None:
            return False
        if (program := job.program) not in self._compiled:
            self._compiling[program] = job.number
        self._start(job, place)
        return True

    def _start(self, job: Job, place: Place) -> None:
        run = self._paths.job(job.number)
        config = placed(job, run, place, self._plan.backend)
        order, log = self._paths.order(job.number), self._paths.log(job.number)
        child = start(job, place, to_dict(config), order, log, self._variables(place))
        self._running[job.number] = child
        self._backend.started(child.process.pid)
        self._readers[job.number] = MetricsReader(run.metrics)
        job.progress.state, job.progress.place = "running", place.label

    def _variables(self, place: Place) -> dict[str, str]:
        if not place.devices:
            return {}
        found = {"CUDA_VISIBLE_DEVICES": ",".join(place.devices)}
        # The daemon of one GPU is of no use to a job that has several.
        pipe = self._backend.environment(place.slices[0].gmi).get(PIPE_VARIABLE)
        if pipe is not None and len(place.devices) == 1:
            found[PIPE_VARIABLE] = pipe
        return found

    def _look(self) -> None:
        for number, child in list(self._running.items()):
            job, progress = child.job, child.job.progress
            progress.wall_s = child.wall_s
            for line in self._readers[number].new():
                progress.take(line, self._sweep)
                self._has_compiled(job)
            if child.has_ended():
                self._finish(child)
            elif not child.is_pruned and self._study.is_hopeless(job):
                child.is_pruned = True
                child.ask_to_stop()

    def _finish(self, child: Child) -> None:
        job, progress = child.job, child.job.progress
        del self._running[job.number]
        wait_until_gone(members_of(child.process.pid), _KILL_AFTER_S)
        is_interrupted, error = child.close()
        self._places.give_back(child.place)
        self._has_compiled(job)
        progress.read(self._paths.job(job.number), self._sweep)
        progress.place, progress.error = "", error
        progress.state = "failed" if error else "completed"
        if is_interrupted:
            progress.state = "pruned" if child.is_pruned else "interrupted"
        self._study.tell(job)

    def _has_compiled(self, job: Job) -> None:
        """Its metrics are there, or it has ended: nobody waits for it any more."""
        program = job.program
        if self._compiling.get(program) == job.number:
            del self._compiling[program]
            self._compiled.add(program)

    def _stop(self, signals: StopSignals) -> None:
        """Asks all jobs to save and end; the same signal again ends them at once."""
        for child in self._running.values():
            child.ask_to_stop()
        limits = [child.job.config.run for child in self._running.values()]
        longest_s = max((run.stop_timeout_s + run.grace_s for run in limits), default=0.0)
        deadline_s = time.monotonic() + longest_s + _KILL_AFTER_S
        while self._running and time.monotonic() < deadline_s and signals.requests < 2:
            self._look()
            self._on_tick()
            time.sleep(_TICK_S)

    def _kill_all(self) -> None:
        left = list(self._running.values())
        for child in left:
            child.kill()
        for child in left:
            self._finish(child)
