"""What the scheduler asks of jobs of any kind: training runs of gmijax, or other commands."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from gmijax.runs.folder import RunPaths
from gmijax.sweeps.children import Process
from gmijax.sweeps.progress import Progress
from gmijax.sweeps.running import J, JobOutcome, Running
from gmijax.sweeps.slots import Slot


class AnyJob(Protocol):
    """One job, whatever it runs."""

    @property
    def number(self) -> int:
        """From 0."""
        ...

    @property
    def overrides(self) -> Mapping[str, str]:
        """What makes it different from the other jobs, e.g. `{"seed": "1"}`."""
        ...

    @property
    def label(self) -> str:
        """That in one line; nothing if there is none."""
        ...

    @property
    def progress(self) -> Progress:
        """How far it is."""
        ...

    @property
    def num_gpus(self) -> int:
        """How many GPUs it takes a slot on."""
        ...

    @property
    def program(self) -> str:
        """The same for jobs that compile the same programs."""
        ...

    @property
    def num_timesteps(self) -> int | None:
        """Environment steps at its end; None: not known."""
        ...


class Reader(Protocol):
    """Follows how far a job is."""

    def new(self) -> list[dict[str, Any]]:
        """Lines of metrics that came since the last call."""
        ...


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

    def why_hung(self, running: Running[J]) -> str | None:
        """Why a process is to be ended that does nothing; None: it does."""
        ...

    def outcome(self, running: Running[J], job: J) -> JobOutcome:
        """How one of the jobs of a process has ended."""
        ...

    def max_restarts(self, job: J) -> int:
        """How often it may be started again after a fault."""
        ...

    def stop_s(self, job: J) -> float:
        """Seconds that it may take to save and end."""
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


def label_of(overrides: Mapping[str, str]) -> str:
    """Overrides in one line."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def trainings_per_hour(jobs: Sequence[AnyJob]) -> float | None:
    """Of the jobs that this command has run, from the first start to the last end, or until now.

    None: it has not started any.
    """
    run = [job.progress for job in jobs if job.progress.started_s is not None]
    if not run:
        return None
    first_s = min(progress.started_s or 0.0 for progress in run)
    last_s = max(progress.ended_s or time.monotonic() for progress in run)
    return 3600 * sum(progress.state == "completed" for progress in run) / (last_s - first_s)
