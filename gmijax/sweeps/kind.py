"""What the scheduler asks of jobs of any kind: training runs of gmijax, or other commands."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from gmijax.runs.folder import RunPaths
from gmijax.sweeps.any_job import J
from gmijax.sweeps.children import Process
from gmijax.sweeps.running import JobOutcome, Reader, Running
from gmijax.sweeps.slots import Slot


class JobStart(NamedTuple):
    """What starts jobs.

    Attributes:
      process: see there.
      readers: of each of the jobs.
      is_awaited: whether jobs with the same `program` wait for its first report, to find what it
        has compiled.
    """

    process: Process
    readers: tuple[Reader, ...]
    is_awaited: bool = False


class Kind(Protocol[J]):
    """The kind of the jobs of a scheduler."""

    def together(self, job: J, queue: Sequence[J], alone: Collection[int]) -> tuple[J, ...]:
        """The job, and those in the queue that may run in one process with it."""
        ...

    def start(self, jobs: tuple[J, ...], slot: Slot) -> JobStart:
        """What runs them there."""
        ...

    def require_ranked(self, line: Mapping[str, Any]) -> None:
        """A job has written this line of metrics.

        Raises:
          ConfigError: jobs have not what they are to be compared by.
        """
        ...

    def why_hung(self, running: Running[J]) -> str | None:
        """Why a process is to be ended that does nothing; None: it does."""
        ...

    def outcome(self, running: Running[J], job: J) -> JobOutcome:
        """How one of the jobs of a process has ended."""
        ...

    def max_restarts(self, job: J) -> int:
        """How often it may be started again after a fault."""
        ...

    def stop_s(self, job: J, *, is_urgent: bool) -> float:
        """Seconds that it may take to save and end; after Ctrl-C it is not urgent."""
        ...

    def ended(self, job: J, run: RunPaths) -> None:
        """It has ended for good.

        Raises:
          OSError: what it leaves cannot be written.
        """
        ...


class Limiter(Protocol[J]):
    """Changes how many jobs run at once on each GPU."""

    def look(self, running: Sequence[Running[J]]) -> Sequence[Running[J]]:
        """Sees how far all jobs are; returns those that are to be ended, and run again later."""
        ...

    def forbid(self, running: Running[J], why: str) -> bool:
        """Lowers the limit of its GPU below the number of its jobs; returns whether it could."""
        ...
