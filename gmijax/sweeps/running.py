"""A process that runs, with its jobs, and how it has ended."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, Protocol

from gmijax.clock import running_s
from gmijax.sweeps.any_job import J
from gmijax.sweeps.children import ChildStatus
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.slots import Slot


class Reader(Protocol):
    """Follows how far a job is."""

    def new(self) -> list[dict[str, Any]]:
        """Lines of metrics that came since the last call."""
        ...


class JobOutcome(NamedTuple):
    """How a job has ended; completed if neither of the first two is so.

    Attributes:
      is_interrupted: whether it was asked to end.
      error: why it failed.
      is_fault: whether it may be tried again: its machine is gone, its controller was killed, or
        the process that it shared with others is. From other faults a job with processes of its
        own continues by itself.
      may_be_neighbours: whether a neighbour on its GPU may have caused it.
      is_out_of_memory: whether it found no memory on its GPU.
      again: why it is to be tried again without being counted; None: it is not.
    """

    is_interrupted: bool = False
    error: str | None = None
    is_fault: bool = False
    may_be_neighbours: bool = False
    is_out_of_memory: bool = False
    again: str | None = None


@dataclass
class Running(Generic[J]):
    """A process of jobs that runs: of one, or of several that are trained together.

    Attributes:
      jobs: what it runs.
      slot: where.
      host: the machine.
      child_id: of the process on `host`.
      readers: of their metrics.
      started_s: when, by the clock of this process.
      kill_at_s: when it is ended by force, by the clock of this process; None: it may continue.
      was_urgent: whether it was asked to end as soon as it can.
      is_pruned: whether it was asked to end because others are better.
      is_retracted: whether that was because fewer are to run at once.
      hang_reason: why it was killed as hung; None: it was not.
      kill_sent: whether it was ended by force.
      ended_by_shutdown: whether it was killed because the sweep ends.
    """

    jobs: tuple[J, ...]
    slot: Slot
    host: Host
    child_id: int
    readers: tuple[Reader, ...]
    started_s: float = field(default_factory=running_s)
    kill_at_s: float | None = None
    was_urgent: bool = False
    is_pruned: bool = False
    is_retracted: bool = False
    hang_reason: str | None = None
    kill_sent: bool = False
    ended_by_shutdown: bool = False

    @property
    def is_asked(self) -> bool:
        """Whether it was asked to end."""
        return self.kill_at_s is not None

    def look(self) -> ChildStatus | None:
        """How it is; None: that is not known."""
        return self.host.look(self.child_id)

    def order_stop(self, limit_s: float, *, is_urgent: bool) -> None:
        """Asks it to save and end within so many seconds; once, and once more if it is urgent."""
        if self.was_urgent or (self.is_asked and not is_urgent):
            return  # A second time would end it without saving.
        self.kill_at_s = min(self.kill_at_s or math.inf, running_s() + limit_s)
        self.was_urgent = is_urgent
        self.host.order(self.child_id, "ask_to_stop" if is_urgent else "interrupt")

    def kill(self) -> None:
        """Ends it; once."""
        if not self.kill_sent:
            self.kill_sent = True
            self.host.order(self.child_id, "kill")

    def kill_if_late(self) -> None:
        """Ends it if it was asked and has not ended in time."""
        if self.kill_at_s is not None and running_s() > self.kill_at_s:
            self.kill()

    def is_over(self) -> bool:
        """Whether it has ended, or its machine is gone."""
        seen = self.look()
        return self.host.lost is not None or (seen is not None and seen.exit_code is not None)
