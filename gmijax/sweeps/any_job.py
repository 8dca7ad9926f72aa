"""What every job of a sweep or a pack is known by, and what is computed from that alone."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from gmijax.sweeps.progress import Progress


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


J = TypeVar("J", bound=AnyJob)


def label_of(overrides: Mapping[str, str]) -> str:
    """Overrides in one line."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def trainings_per_hour(jobs: Sequence[AnyJob]) -> float | None:
    """Of the jobs that this command has run, from the first start to the last end, or until now.

    None: it has not started any.
    """
    run = [job.progress for job in jobs if job.progress.first_started_s is not None]
    if not run:
        return None
    first_s = min(progress.first_started_s or 0.0 for progress in run)
    last_s = max(progress.ended_s or time.monotonic() for progress in run)
    return 3600 * sum(progress.state == "completed" for progress in run) / (last_s - first_s)
