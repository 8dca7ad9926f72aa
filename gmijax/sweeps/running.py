"""A process of a sweep that runs, with the jobs that it trains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from gmijax.control.exit_codes import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import MetricsReader
from gmijax.supervise.failures import signal_name
from gmijax.sweeps.children import Seen
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import own_end
from gmijax.sweeps.places import Place


class Outcome(NamedTuple):
    """How a job has ended; completed if neither of the first two is so.

    Attributes:
      is_interrupted: whether it was asked to end.
      error: why it failed.
      is_fault: whether it may be tried again: its machine is gone, its controller was killed, or
        the process that it shared with others is. From other faults a job with processes of its
        own goes on by itself.
    """

    is_interrupted: bool = False
    error: str | None = None
    is_fault: bool = False


@dataclass
class Running:
    """A process of jobs that runs: of one, or of several that are trained together.

    Attributes:
      jobs: what it trains.
      place: where.
      host: the machine.
      child: its number there.
      readers: of their metrics.
      is_asked: whether it was asked to end.
      is_pruned: whether that was because others are better.
      is_killed: whether it was ended by force, as the whole sweep is.
    """

    jobs: tuple[Job, ...]
    place: Place
    host: Host
    child: int
    readers: tuple[MetricsReader, ...]
    is_asked: bool = False
    is_pruned: bool = False
    is_killed: bool = False

    def look(self) -> Seen | None:
        """How it is; None: that is not known."""
        return self.host.look(self.child)

    def order_stop(self) -> None:
        """Asks it to save and end."""
        self.is_asked = True
        self.host.order(self.child, "ask_to_stop")

    def is_over(self) -> bool:
        """Whether it has ended, or its machine is gone."""
        seen = self.look()
        return self.host.lost is not None or (seen is not None and seen.exit_code is not None)

    def outcome(self, job: Job, run: RunPaths) -> Outcome:
        """After its end: of one of its jobs, which has this run folder."""
        seen, are_several = self.look() or Seen(None), len(self.jobs) > 1
        if are_several and (own := own_end(job, run)) is not None:
            return Outcome(error=own.error)
        if seen.exit_code == 0 and not are_several:
            return Outcome()
        if self.is_killed or (seen.exit_code == EXIT_INTERRUPTED and self.is_asked):
            return Outcome(is_interrupted=True)
        if seen.exit_code is None:
            return Outcome(error=self.host.lost, is_fault=True)
        if seen.exit_code == EXIT_INTERRUPTED:
            return Outcome(error="a signal from elsewhere interrupted it", is_fault=True)
        if seen.exit_code < 0:
            killed_by = signal_name(-seen.exit_code)
            return Outcome(error=f"its controller was killed by {killed_by}", is_fault=True)
        error = seen.said.removeprefix("gmijax.train: ") or f"exit code {seen.exit_code}"
        return Outcome(error=error, is_fault=are_several and seen.exit_code != EXIT_BAD_INPUT)
