"""Starts the GMIs of a job, watches them, and ends them all, whatever happens.

All or nothing: the first failure ends all GMIs, and no process is left when `run` returns or
raises. Whether the job is tried again is decided by `gmijax.control.restarts`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

from gmijax.clock import running_s
from gmijax.errors import CollectiveTimeout, ConfigError, GmiFailed, JobInterrupted
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.failures import (
    describe_exit,
    ended_with,
    first_cause,
    is_consequence,
    shown_gist,
)
from gmijax.supervise.start_gmi import Launch, StartGmi, start_gmi
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.watched_gmi import GmiStatus, WatchedGmi

_POLL_S = 0.05
_SETTLE_S = 1.0
_KILL_WAIT_S = 10.0
_STACKS_S = 3.0
"""Longest wait for stacks to be written; a process that is stopped never does."""


class Supervisor:
    """Runs one job once.

    Args:
      launch: what to run.
      backend: that of the plan, entered.
      inherited_fds: open files that every GMI inherits, by the environment variable that will
        hold the number of the descriptor.
      start: starts a GMI; None: on this machine.
      signals: looked at for a request to end: the first lets the GMIs finish their iteration and
        save; the second ends them. None: there are no such requests.
    """

    def __init__(
        self,
        launch: Launch,
        backend: Backend,
        inherited_fds: Mapping[str, int] | None = None,
        start: StartGmi | None = None,
        signals: StopSignals | None = None,
    ) -> None:
        self._launch = launch
        self._backend = backend
        self._start_gmi = start or partial(start_gmi, launch, backend, inherited_fds or {})
        self._started: dict[int, WatchedGmi] = {}
        self._all_ready_s: float | None = None
        self._signals = signals or StopSignals()
        self._is_enough = launch.is_enough
        self._is_stopping = False
        self._stop_deadline_s: float | None = None

    def ask_to_finish(self) -> None:
        """Lets the GMIs finish as a first request does; the job then ends well."""
        for process in self._alive():
            process.ask_to_stop()

    def status(self) -> tuple[GmiStatus, ...]:
        """Where every GMI stands, in order of id."""
        return tuple(self._status_of(gmi) for gmi in self._launch.plan.layout.gmis)

    def _status_of(self, gmi: int) -> GmiStatus:
        if gmi not in self._started:
            return GmiStatus(gmi, "starting", 0, None, None)
        status = self._started[gmi].status()
        is_stopping = self._is_stopping and status.state == "running"
        if not is_stopping:
            return status
        return status._replace(state="stopping", stopped_by=self._signals.name)

    def run(self, on_tick: Callable[[tuple[GmiStatus, ...]], None] | None = None) -> None:
        """Runs the job to its end; calls `on_tick` about 20 times a second.

        Raises:
          GmiFailed: a GMI failed, did not start in time, stalled, or runs without the share
            that the plan gives it; names the first one.
          ConfigError: a GMI rejected its input.
          JobInterrupted: a stop was requested, and every GMI has ended.
        """
        try:
            for gmi in self._launch.plan.layout.gmis:
                self._start(gmi)
            while self._alive():
                self._raise_failure()
                self._handle_stop()
                if self._all_ready_s is None and all(p.is_ready for p in self._started.values()):
                    # Once, when every GMI holds its share.
                    self._all_ready_s = running_s()
                    self._verify_shares()
                self._check_progress()
                if on_tick is not None:
                    on_tick(self.status())
                time.sleep(_POLL_S)
            self._raise_failure()
        except BaseException as error:
            if left := self._end_all():
                error.add_note(f"processes {', '.join(left)} do not end: a driver may hold them")
                if isinstance(error, GmiFailed):
                    error.is_final = True  # Nothing may be started beside them.
            raise
        self._end_all()
        if self._signals.have_come:
            raise JobInterrupted("stopped")

    def _alive(self) -> list[WatchedGmi]:
        return [process for process in self._started.values() if process.exit_code is None]

    def _start(self, gmi: int) -> None:
        process = self._start_gmi(gmi)
        self._started[gmi] = process
        self._backend.started(process.pid)

    def _raise_failure(self) -> None:
        """Reads heartbeats and exit codes; raises for the GMI that failed first."""
        failures = self._poll_failures()
        if not failures:
            return
        # A GMI that lost its peer can be quicker to end than that peer is to be seen dead.
        deadline_s = running_s() + _SETTLE_S
        # Nor is a node that is lost known to be so at once.
        while is_consequence(first_cause(failures)) and (
            running_s() < deadline_s or any(p.is_silent for p in self._started.values())
        ):
            time.sleep(_POLL_S)
            failures = self._poll_failures()
        cause = first_cause(failures)
        if ended_with(cause, CollectiveTimeout) and (alive := self._alive()):
            # The stuck GMI is the one that runs and has the oldest heartbeat.
            stuck = min(alive, key=lambda process: process.progress_s)
            self._collect_stacks()
            iteration = stuck.beat.iteration
            what = f"made no progress after iteration {iteration}; GMI {cause.gmi} {cause.reason}"
            raise GmiFailed(stuck.gmi, what, iteration=iteration)
        if cause.error is not None and ended_with(cause, ConfigError):
            # Bad input stays bad input; its line ends with the location.
            raise ConfigError(shown_gist(cause.error.message, None))
        raise cause

    def _poll_failures(self) -> list[GmiFailed]:
        return [
            describe_exit(
                process.gmi,
                process.exit_code,
                process.error,
                process.paths.stderr,
                process.beat.iteration,
            )
            for process in self._started.values()
            if process.poll() and process.exit_code is not None
        ]

    def _handle_stop(self) -> None:
        if self._is_enough is not None and self._is_enough(self.status()):
            self._is_enough = None
            self.ask_to_finish()
        if not self._signals.have_come:
            return
        if self._signals.requests > 1:
            raise JobInterrupted(
                f"stopped at once by a second {self._signals.name}; what was not saved yet is lost"
            )
        if not all(p.is_ready for p in self._started.values()):
            raise JobInterrupted("stopped before the work began")
        if not self._is_stopping:
            self._is_stopping = True
            self.ask_to_finish()
        self._require_in_time()

    def _require_in_time(self) -> None:
        """After Ctrl-C a user waits, and can end it: until then GMIs that work may continue."""
        if self._launch.waits_after_ctrl_c and not self._signals.are_urgent:
            return  # `_check_progress` ends those that hang.
        now_s = running_s()
        if self._stop_deadline_s is None:
            self._stop_deadline_s = now_s + self._launch.timeouts.stop_timeout_s
        elif now_s > self._stop_deadline_s:
            late = [process.gmi for process in self._alive()]
            limit = f"{self._launch.timeouts.stop_timeout_s:g} s"
            if self._launch.waits_after_ctrl_c:
                limit += " (run.stop_timeout_s)"
            raise JobInterrupted(
                f"stopped; GMIs {late} did not finish within {limit} and were ended"
            )

    def _verify_shares(self) -> None:
        # One that has ended already cannot be asked for any more.
        alive = {process.gmi: process.beat.pid for process in self._alive()}
        try:
            self._backend.verify(alive)
        except GmiFailed as error:
            # One that failed meanwhile has lost its share by that, and may have taken the
            # others' with it.
            self._raise_failure()
            if self._started[error.gmi].exit_code is None:
                raise
            self._verify_shares()

    def _check_progress(self) -> None:
        now_s = running_s()
        for process in self._alive():
            state = process.beat.state
            if state == "waiting":
                continue  # The process that compiles has a time limit.
            if state == "done" and now_s - process.progress_s > self._launch.timeouts.grace_s:
                process.end_as_done()
                continue
            if state in ("starting", "compiling"):
                limit_s, since_s = self._launch.timeouts.start_timeout_s, process.progress_s
                what = "did not start and compile"
            elif self._all_ready_s is not None:
                # A GMI that is ready waits for the others without a beat: its clock starts
                # when the last one is ready.
                limit_s = self._launch.timeouts.stall_timeout_s
                since_s = max(process.progress_s, self._all_ready_s)
                what = f"made no progress after iteration {process.beat.iteration}"
            else:
                continue
            if now_s - since_s > limit_s:
                self._collect_stacks()
                raise GmiFailed(
                    process.gmi,
                    f"{what} within {limit_s:g} s (state: {state})",
                    iteration=process.beat.iteration,
                )

    def _collect_stacks(self) -> None:
        """Has all that still run write where their threads are to their logs."""
        sizes = {process: process.request_stacks() for process in self._alive()}
        waiting = {process: size for process, size in sizes.items() if size is not None}
        deadline_s = running_s() + _STACKS_S
        while waiting and running_s() < deadline_s:
            time.sleep(_POLL_S)
            now = {process: process.log_bytes for process in waiting}
            # Written once a log has grown and grows no more.
            waiting = {
                process: now[process]
                for process, before in waiting.items()
                if now[process] == sizes[process] or now[process] != before
            }

    def _end_all(self) -> list[str]:
        """Ends every process that is left: backend, order to end, grace, SIGKILL, lifeline.

        Returns:
          Those that are still there.
        """
        alive = [process for process in self._started.values() if process.poll() is None]
        for process in alive:
            # Whatever is wrong with the backend, the processes must end.
            with suppress(Exception):
                self._backend.terminate(process.gmi, [process.beat.pid])
        for process in alive:
            process.order_end()
        alive = _wait_for_end(alive, self._launch.timeouts.grace_s)
        for process in alive:
            process.kill()
        alive = _wait_for_end(alive, _KILL_WAIT_S)
        for process in self._started.values():
            process.close()
        return [process.process_name for process in alive]


def _wait_for_end(processes: Sequence[WatchedGmi], timeout_s: float) -> list[WatchedGmi]:
    """Waits until all have ended; returns those that have not."""
    deadline_s = running_s() + timeout_s
    alive = [process for process in processes if process.poll() is None]
    while alive and running_s() < deadline_s:
        time.sleep(_POLL_S)
        alive = [process for process in alive if process.poll() is None]
    return alive
