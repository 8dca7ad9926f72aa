"""A started GMI as the supervisor sees it, on whatever machine it runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from gmijax.clock import running_s
from gmijax.errors import ReportedError
from gmijax.runs.folder import GmiPaths
from gmijax.supervise.heartbeat import Heartbeat


class GmiStatus(NamedTuple):
    """Where a GMI stands.

    Attributes:
      gmi: its id.
      state: `stopping` once a running one was asked to end, else from its `heartbeat`.
      iteration: training iterations done.
      pid: its process, None before the start.
      exit_code: None while it runs; negative for the signal that ended it.
      stopped_by: what has asked the job to end, see `StopSignals.name`; empty: nothing.
    """

    gmi: int
    state: str
    iteration: int
    pid: int | None
    exit_code: int | None
    stopped_by: str = ""


class WatchedGmi(ABC):
    """A started GMI.

    Attributes:
      gmi: its id.
      pid: the process that was started, leader of its group.
      exit_code: None while it runs; negative for the signal that ended it.
      beat: the newest heartbeat that `poll` saw.
      beats: how many of them there were.
      paths: files of this GMI.
      progress_s: when it was started, or its heartbeat last seen to be a new one;
        by `running_s`.
      is_silent: whether its machine does not answer, so that nothing new is known of it.
    """

    is_silent = False

    def __init__(self, gmi: int, paths: GmiPaths, pid: int) -> None:
        self.gmi = gmi
        self.paths = paths
        self.exit_code: int | None = None
        self.beat = Heartbeat("starting", 0, pid)
        self.beats = 0
        self.progress_s = running_s()
        self.pid = pid
        self._was_ready = False

    @property
    def process_name(self) -> str:
        """Its process, for the user."""
        return str(self.pid)

    @property
    def is_ready(self) -> bool:
        """Whether the GMI has once been ready, or has ended well without reporting it."""
        return self._was_ready or self.exit_code == 0

    def status(self) -> GmiStatus:
        """A snapshot for progress displays."""
        beat = self.beat
        return GmiStatus(self.gmi, beat.state, beat.iteration, beat.pid, self.exit_code)

    @property
    @abstractmethod
    def error(self) -> ReportedError | None:
        """The exception that it reported before it ended, None without one."""

    @property
    @abstractmethod
    def log_bytes(self) -> int:
        """Size of what it has written to stderr."""

    @abstractmethod
    def poll(self) -> int | None:
        """Reads the heartbeat and the exit code; ends what is left of an ended GMI's group."""

    @abstractmethod
    def ask_to_stop(self) -> None:
        """Asks the GMI to finish its iteration, save and end."""

    @abstractmethod
    def order_end(self) -> None:
        """Makes the GMI and all that it started end at once, without saving."""

    @abstractmethod
    def request_stacks(self) -> int | None:
        """Has the GMI write the stacks of its threads to its log; the log's size before.

        None where it has not started far enough for that: the signal would end it.
        """

    @abstractmethod
    def end_as_done(self) -> None:
        """Ends a GMI that has reported that it is done, but whose process stays."""

    @abstractmethod
    def kill(self) -> None:
        """Kills the GMI and everything it started; nothing once it is reaped."""

    @abstractmethod
    def close(self) -> None:
        """Drops the lifeline: a process that is still there ends itself."""

    def _record_heartbeat(self, beats: int, beat: Heartbeat | None) -> None:
        """Records the newest heartbeat; one with equal content counts as progress too."""
        if beats != self.beats and beat is not None:
            self.beat, self.beats = beat, beats
            self._was_ready |= beat.is_ready
            self.progress_s = running_s()
