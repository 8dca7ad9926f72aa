"""What a job does before it trains, why that takes its time, and for how long."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from gmijax.control.display import clock
from gmijax.runs.compile_times import CompileTime
from gmijax.supervise.watched_gmi import GmiStatus

BEFORE_RUNNING: Final = ("starting", "waiting", "compiling")

_STOPPING: Final = (
    "stopping: finishing the iterations that have begun, then saving; a second {} ends at once, "
    "without saving"
)

_LONG_S: Final = 180.0
"""Compiling for longer than that is not usual."""


class Phases:
    """The phase of a job, and since when.

    Args:
      compile_time: what is known of the time that compiling takes; None: nothing.
      work: what it does once it runs, in words.

    Attributes:
      now: the phase; empty before `enter` was called.
    """

    def __init__(self, compile_time: CompileTime | None = None, work: str = "running") -> None:
        self._compile_time, self._work = compile_time, work
        self.now, self._began_s = "", time.monotonic()
        self._is_noted = False

    def enter(self, gmis: Sequence[GmiStatus]) -> str | None:
        """Updates the phase from the states of the GMIs; the line for a new one, if any."""
        before, phase = self.now, _phase_of(gmis)
        if phase == before:
            return None
        now_s = time.monotonic()
        took_s, self.now, self._began_s = now_s - self._began_s, phase, now_s
        if phase == "stopping":
            return _STOPPING.format(next(filter(None, (gmi.stopped_by for gmi in gmis)), "Ctrl-C"))
        if (before, phase) != ("compiling", "running"):
            return None
        if self._compile_time is not None and not self._is_noted:
            self._compile_time.note(took_s)
        self._is_noted = True  # What it compiles after a restart is in the cache.
        return f"compiled in {clock(took_s)}" if took_s >= 1 else None

    def text(self) -> str:
        """What is done, why, and for how long."""
        waited_s = time.monotonic() - self._began_s
        return f"{self._reason(waited_s)}  {clock(waited_s)}"

    def _reason(self, waited_s: float) -> str:
        if self.now == "compiling":
            last_s = None if self._compile_time is None else self._compile_time.last_s
            usual = "up to 3 minutes" if last_s is None else f"last time {clock(last_s)}"
            if last_s is not None and last_s < 1:
                usual = "last time less than a second"
            if waited_s > 2 * (last_s or _LONG_S):
                usual += ", longer now"
            return f"compiling: once for each task and size, {usual}"
        if self.now == "waiting":
            return "waiting: another job compiles the same programs"
        if self.now == "starting":
            return "starting: loading JAX, building the environments"
        return self._work if self.now == "running" else self.now


def _phase_of(gmis: Sequence[GmiStatus]) -> str:
    """Phase of the job: that of its slowest GMIs."""
    states, early = {gmi.state for gmi in gmis}, {"starting", "waiting"}
    if states == {"waiting"}:
        return "waiting"
    if states and states <= early:
        return "starting"
    if states & {*early, "compiling"}:
        return "compiling"
    return "stopping" if "stopping" in states else "running"
