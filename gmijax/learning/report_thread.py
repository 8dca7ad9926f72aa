"""Reports in a thread of their own, so that the device does not wait for them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from gmijax.clock import wait_for

LAST_LINE_S = 2.0
"""Longest wait for a report when training ends, however it ends."""


class ReportThread:
    """Calls a function in a thread of its own, one call after the other.

    To start an iteration takes the host about as long as the device takes for it. So the thread
    that starts the next one notices too late that this one has ended, and the device would wait
    while its line is written.

    Args:
      report: the function; used by the thread only, until `stop`.
    """

    def __init__(self, report: Callable[..., None], last_line_s: float = LAST_LINE_S) -> None:
        self._report, self._last_line_s = report, last_line_s
        self._queue: SimpleQueue[tuple[Any, ...] | None] = SimpleQueue()
        self._is_idle = threading.Event()
        self._is_idle.set()
        self._error: Exception | None = None
        # A daemon: a device that hangs must not keep a process alive that has failed.
        threading.Thread(target=self._run, name="report", daemon=True).start()

    def report(self, *arguments: Any) -> None:
        """Calls the function soon; returns when the call before is done, and raises its error."""
        self.wait()
        self._is_idle.clear()
        self._queue.put(arguments)

    @property
    def is_idle(self) -> bool:
        """Whether all is reported, or a call has failed."""
        return self._is_idle.is_set()

    def wait(self) -> None:
        """Returns when all is reported; raises the error of a call."""
        self._is_idle.wait()
        if self._error is not None:
            raise self._error

    def give_up(self) -> None:
        """Marks that what the thread waits for will not come: `stop` does not wait for it."""
        self._is_idle.set()

    def stop(self) -> None:
        """Ends the thread, which may finish a call. Idempotent."""
        wait_for(self._is_idle.wait, self._last_line_s)
        self._queue.put(None)

    def _run(self) -> None:
        while (waiting := self._queue.get()) is not None:
            try:
                self._report(*waiting)
            # Whatever it is, it is raised by the caller's next call.
            except Exception as error:
                self._error = error
            self._is_idle.set()
