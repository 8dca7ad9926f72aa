"""Runs the jobs of a sweep, as many at a time as there are places."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress

from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import JobInterrupted
from gmijax.machine.mps_control import PIPE_VARIABLE
from gmijax.machine.processes import members_of, wait_until_gone
from gmijax.machine.snapshot import DAEMONS_VARIABLE
from gmijax.runs.folder import add_event, is_locked
from gmijax.runs.history import MetricsReader
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.failures import may_be_anothers
from gmijax.supervise.launcher import StopSignals
from gmijax.sweeps.children import Child, start
from gmijax.sweeps.compiled import CompiledPrograms
from gmijax.sweeps.hparams import write_hparams
from gmijax.sweeps.jobs import Job, SweepPaths, placed
from gmijax.sweeps.places import Place, Places
from gmijax.sweeps.study import Study

_TICK_S = 0.1
_KILL_AFTER_S = 15.0
"""Beyond what a job gives its GMIs to save and end."""


class Scheduler:
    """Starts jobs where there is room, reads how far they are, and ends them when told to.

    A job that fails ends alone. But where it shared an MPS daemon, and the fault may have been
    that of another client, it is run once more, from its last checkpoint and alone on its GPU.

    Args:
      jobs: those that are known; those that are `waiting` are run. More come from the study.
      study: see above; is told how jobs do.
      sweep: settings.
      paths: files of the sweep.
      places: of the jobs.
      backend: of the plan of the places, entered.
      on_tick: called ten times a second.
    """

    def __init__(
        self,
        jobs: list[Job],
        study: Study,
        sweep: SweepConfig,
        paths: SweepPaths,
        places: Places,
        backend: Backend,
        on_tick: Callable[[], None],
    ) -> None:
        self._jobs, self._study = jobs, study
        self._queue = [job for job in jobs if job.progress.state == "waiting"]
        self._sweep, self._paths = sweep, paths
        self._places, self._backend, self._on_tick = places, backend, on_tick
        self._alone: set[int] = set()
        self._running: dict[int, Child] = {}
        self._readers: dict[int, MetricsReader] = {}
        self._compiled = CompiledPrograms()
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
        place = self._places.take(job.num_gpus, alone=job.number in self._alone)
        if place is None:
            return False
        if not self._compiled.holds(job):
            self._compiling[job.program] = job.number
        self._start(job, place)
        return True

    def _start(self, job: Job, place: Place) -> None:
        run = self._paths.job(job.number)
        # Alone on a GPU a job does as it would without a sweep.
        backend = "auto" if self._sweep.jobs_per_gpu == 1 else self._backend.plan.backend
        config = placed(job, run, place, backend)
        order, log = self._paths.order(job.number), self._paths.log(job.number)
        variables = variables_of(place, self._backend)
        self._readers[job.number] = reader = MetricsReader(run.metrics)
        progress = job.progress
        progress.read(run, self._sweep)
        reader.new()  # Those are an earlier attempt's.
        child = start(job, place, to_dict(config), order, log, variables)
        self._running[job.number] = child
        self._backend.started(child.process.pid)
        progress.state, progress.place, progress.error = "running", place.label, None
        progress.started_s, progress.updated_s, progress.ended_s = time.monotonic(), None, None

    def _look(self) -> None:
        for number, child in list(self._running.items()):
            job, progress = child.job, child.job.progress
            for line in self._readers[number].new():
                progress.take(line, self._sweep)
                progress.updated_s = progress.updated_s or time.monotonic()
                self._nobody_waits_for(job, has_compiled=True)
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
        self._nobody_waits_for(job, has_compiled=False)
        run = self._paths.job(job.number)
        progress.read(run, self._sweep)
        progress.place, progress.error, progress.ended_s = "", error, time.monotonic()
        progress.state = "failed" if error else "completed"
        if is_interrupted:
            progress.state = "pruned" if child.is_pruned else "interrupted"
        elif error and self._may_be_anothers(job, error):
            self._alone.add(job.number)
            self._queue.append(job)
            progress.state, progress.error = "waiting", f"again, alone on its GPU, after {error}"
            add_event(run.events, "again", reason=progress.error)
            return
        with suppress(OSError):  # A full disk must not end the sweep.
            write_hparams(job, run, self._sweep.objective)
        self._study.tell(job)

    def _may_be_anothers(self, job: Job, error: str) -> bool:
        """Whether a job that may start again failed by what another one may have done."""
        has_daemon = self._backend.plan.backend in ("mps", "mig")
        may_restart = job.config.run.max_restarts > 0 and job.number not in self._alone
        return has_daemon and may_restart and may_be_anothers(error)

    def _nobody_waits_for(self, job: Job, *, has_compiled: bool) -> None:
        """Its metrics are there, or it has ended, perhaps before it had compiled."""
        if self._compiling.get(job.program) == job.number:
            del self._compiling[job.program]
            self._compiled.add(job, is_lasting=has_compiled)

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


def variables_of(place: Place, backend: Backend) -> dict[str, str]:
    """What tells a job at a place its GPUs, and the daemon of each; a dead daemon is renewed."""
    if not place.devices:
        return {}
    daemons: dict[str, str] = {}
    for share in place.slices:
        backend.renew(share.gmi)
        if pipe := backend.environment(share.gmi).get(PIPE_VARIABLE):
            daemons[share.device] = pipe
    devices = ",".join(place.devices)
    return {"CUDA_VISIBLE_DEVICES": devices, DAEMONS_VARIABLE: json.dumps(daemons)}
