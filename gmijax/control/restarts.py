"""Runs a job again from its last good checkpoint when GMIs were lost.

An attempt ends with all its processes, shared memory and daemons; the next one starts anew in the
same run folder, on the GPUs that are left. What cannot get better by trying again ends the job at
once.
"""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.control.run_folder import clear_unfinished, keep_logs
from gmijax.errors import BackendUnavailable, ConfigError, GmiFailed, JobInterrupted
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint
from gmijax.runs.folder import RunPaths, add_event
from gmijax.supervise.run_gmis import Launch, OnTick, run_gmis
from gmijax.supervise.stop_signals import StopSignals, stop_signals
from gmijax.supervise.watched_gmi import GmiStatus

_LASTING = ("NonFiniteError", "ParameterMismatch", "SelfCheckFailed")
"""Errors of a GMI that the next attempt would have too."""

_DISK_IS_FULL = os.strerror(errno.ENOSPC)
"""In the message of whatever could not be written."""

_FRAME = re.compile(r'^ +File "(.+)", line (\d+), in (.+)$', re.MULTILINE)


class Restart(NamedTuple):
    """One time that a job was started again, for `summary.json`.

    Attributes:
      time: of the fault, ISO 8601.
      gmi: the one that failed first.
      cause: in one line.
      iteration: iterations that it had done.
      checkpoint: where the job went on from; None: its beginning.
    """

    time: str
    gmi: int
    cause: str
    iteration: int
    checkpoint: str | None


@dataclass
class Attempts:
    """The attempts at one job.

    Attributes:
      run: its folder.
      max_restarts: allowed in a row; a new checkpoint begins the count again.
      launch_at: what to start from a checkpoint (None: from the beginning), by number of the
        attempt; raises ConfigError if nothing can be started any more.
      say: takes a line for the user.
      run_attempt: runs an attempt to its end; see `run_gmis`.
      require_folder: raises what comes before any fault of a GMI: that its folder is gone.
      restarts: those so far.
    """

    run: RunPaths
    max_restarts: int
    launch_at: Callable[[Path | None, int], Launch]
    say: Callable[[str], None]
    run_attempt: Callable[[Launch, OnTick, StopSignals], None] | None = None
    require_folder: Callable[[], None] = lambda: None
    restarts: list[Restart] = field(default_factory=list)
    _seen_s: float = 0.0

    def run_to_the_end(self, checkpoint: Path | None, on_tick: OnTick) -> None:
        """Runs the job; raises as `run_gmis` of the last attempt does."""
        budget, last, reached = self.max_restarts, None, _steps(checkpoint)
        is_own = checkpoint is not None and checkpoint.parent == self.run.checkpoints
        # Before its own first one, a resumed run continues from the one that it was resumed from.
        origin = None if is_own else checkpoint
        with stop_signals() as signals:
            while True:
                try:
                    self._attempt(checkpoint, on_tick, signals)
                    return
                except GmiFailed as error:
                    self.require_folder()
                    reason = why_not_again(error, last)
                    newest = self._newest() or origin
                    if _steps(newest) > reached:
                        budget, reached = self.max_restarts, _steps(newest)
                    if reason is None and budget == 0:
                        reason = f"no restarts are left (run.max_restarts={self.max_restarts})"
                    if reason is not None or signals.have_come:
                        self._give_up(error, reason)
                        raise
                    budget, last = budget - 1, error
                    self._prepare_again(error, newest)
                    checkpoint = newest

    def _attempt(self, checkpoint: Path | None, on_tick: OnTick, signals: StopSignals) -> None:
        number = len(self.restarts)
        try:
            launch = self.launch_at(checkpoint, number)
        except ConfigError as error:
            if not number:
                raise
            raise self._last_fault(error) from error
        if signals.have_come:
            raise JobInterrupted("stopped between two attempts")
        add_event(self.run.events, "start", attempt=number, checkpoint=_text(checkpoint))
        try:
            run = self.run_attempt or run_gmis
            run(launch, self._ticks(on_tick, number), signals)
        except BackendUnavailable as error:
            if not number:
                raise
            raise self._last_fault(error) from error
        add_event(self.run.events, "end", attempt=number)

    def _ticks(self, on_tick: OnTick, attempt: int) -> OnTick:
        """`on_tick`, and a note when a job that was started again trains again."""
        is_over = attempt == 0

        def tick(gmis: tuple[GmiStatus, ...]) -> None:
            nonlocal is_over
            on_tick(gmis)
            if not is_over and any(gmi.state == "running" for gmi in gmis):
                is_over = True
                seconds = round(time.monotonic() - self._seen_s, 3)
                add_event(self.run.events, "recovered", attempt=attempt, seconds=seconds)

        return tick

    def _last_fault(self, why: ConfigError) -> GmiFailed:
        """What ended the attempt before, after which the machine cannot continue."""
        fault = self.restarts[-1]
        failed = GmiFailed(fault.gmi, fault.cause, iteration=fault.iteration)
        failed.add_note(f"cannot start again: {why}")
        failed.is_final = True
        return failed

    def _newest(self) -> Path | None:
        found = newest_checkpoint(self.run.root)
        for text in found.passed_over:
            self.say(text)
            add_event(self.run.events, "passed_over", what=text)
        return found.checkpoint

    def _prepare_again(self, error: GmiFailed, newest: Path | None) -> None:
        number = len(self.restarts)
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        self.restarts.append(Restart(now, error.gmi, error.reason, error.iteration, _text(newest)))
        self._seen_s = error.seen_s
        add_event(self.run.events, "fault", attempt=number, **_about(error))
        self.say(f"{error}; starting again from {newest or 'the beginning'}")
        try:
            keep_logs(self.run)
            clear_unfinished(self.run, newest)
        except OSError as full:
            error.add_note(f"not started again: {full}")
            raise error from full

    def _give_up(self, error: GmiFailed, reason: str | None) -> None:
        add_event(self.run.events, "fault", attempt=len(self.restarts), **_about(error))
        if reason is not None:
            error.add_note(f"not started again: {reason}")
            add_event(self.run.events, "gave_up", reason=reason)


def why_not_again(error: GmiFailed, last: GmiFailed | None) -> str | None:
    """Why a job that failed should not be tried again, None if it should."""
    if error.is_final:
        return "the last attempt left something behind, or nothing can be started"
    if (reported := error.error) is None:
        # A library has ended the process, e.g. for an unknown flag. A signal may have come from
        # outside.
        before = None if last is None or last.error else (last.exit_code, last.iteration)
        if error.exit_code > 0 and before == (error.exit_code, error.iteration):
            return f"exit code {error.exit_code} at the same iteration ({error.iteration}) twice"
        return None
    if reported.type in _LASTING:
        return f"{reported.type} would happen again"
    if _DISK_IS_FULL in reported.message:
        return "the disk is full"
    if last is not None and last.error is not None:
        same = (error.iteration, reported.type, _frames(reported.traceback))
        if same == (last.iteration, last.error.type, _frames(last.error.traceback)):
            return f"the same error at the same iteration ({error.iteration}) twice"
    return None


def _about(error: GmiFailed) -> dict[str, Any]:
    return {"gmi": error.gmi, "cause": error.reason, "iteration": error.iteration}


def _frames(traceback: str) -> Sequence[tuple[str, ...]]:
    # Not the message: it may hold addresses and sizes.
    return _FRAME.findall(traceback)


def _steps(checkpoint: Path | None) -> int:
    return -1 if checkpoint is None else CheckpointMeta.read(checkpoint).env_steps


def _text(checkpoint: Path | None) -> str | None:
    return None if checkpoint is None else str(checkpoint)
