"""A clock for time limits, which stands still while this process does. Stdlib only.

A process may be stopped as a whole: `scontrol suspend`, `docker pause`, Ctrl-Z, a snapshot of a
virtual machine. If times are only compared, all other processes then seem to have hung.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

LONGEST_LOOK_S: Final = 1.0
"""Between two looks at the clock no more than this counts.

Waits look far more often. So a process that runs, on a busy machine too, loses little.
"""


class RunningClock:
    """Seconds that are counted while this process looks at them; from any thread."""

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._left_out_s = 0.0
        self._lock = threading.Lock()

    def __call__(self) -> float:
        """The time, of which only differences mean something."""
        now_s = time.monotonic()
        if now_s - self._looked_s > LONGEST_LOOK_S:
            self._leave_out()
        self._looked_s = now_s
        return now_s - self._left_out_s

    def _leave_out(self) -> None:
        with self._lock:  # Two threads may see the same gap; it is left out once.
            now_s = time.monotonic()
            gap_s = now_s - self._looked_s
            self._looked_s = now_s
            if gap_s > LONGEST_LOOK_S:
                self._left_out_s += gap_s - LONGEST_LOOK_S


running_s: Final = RunningClock()
"""The clock of this process. A wait by it looks at it at least twice a second."""


def wait_for(wait: Callable[[float], bool], timeout_s: float) -> bool:
    """Waits until `wait(seconds)` is true, such as that of an event; whether it was in time.

    Only time in which this process runs counts, which one long `wait` could not show.
    """
    deadline_s = running_s() + timeout_s
    while not wait(max(0.0, min(LONGEST_LOOK_S / 4, deadline_s - running_s()))):
        if running_s() >= deadline_s:
            return False
    return True
