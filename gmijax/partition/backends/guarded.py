"""What all backends share: a janitor that ends what they started if the controller is killed."""

from __future__ import annotations

from typing import Any, Self

from gmijax.partition.janitor import JanitorLink
from gmijax.rundir import RunPaths


class GuardedBackend:
    """A job's janitor while the backend is entered; see `Backend` for the methods.

    Args:
      run: the janitor's log goes into it.
    """

    def __init__(self, run: RunPaths) -> None:
        self._janitor_log = run.janitor_log
        self._janitor: JanitorLink | None = None

    def __enter__(self) -> Self:
        """Starts the janitor."""
        self._janitor = JanitorLink(self._janitor_log)
        return self

    def __exit__(self, *exc: Any) -> None:
        """Dismisses it."""
        if self._janitor is not None:
            self._janitor.dismiss()
            self._janitor = None

    def started(self, gmi: int, pid: int) -> None:
        """Tells the janitor."""
        del gmi
        if self._janitor is not None:
            self._janitor.watch_gmi(pid)
