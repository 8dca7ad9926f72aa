"""How a process waits for another one: with pauses, and with an eye on whether that one lives."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

from gmijax.clock import running_s
from gmijax.errors import GmijaxError

T = TypeVar("T")

SPIN_S = 200e-6
"""How long a waiting process only gives way before it sleeps.

Processes that do equal work arrive within microseconds of each other if every one has a core.
"""

MIN_SLEEP_S, MAX_SLEEP_S = 10e-6, 100e-6
LIVENESS_PERIOD_S = 0.2


def wait_until(
    ready: Callable[[], T | None], check: Callable[[], GmijaxError | None], timeout_s: float
) -> T | None:
    """Returns what `ready` returns once it is not None; None when the time is up.

    Args:
      ready: cheap; asked again and again.
      check: called five times a second, and at the end; an error of a lost peer, which is raised
        unless `ready` has something after all (a process may deliver and end meanwhile).
      timeout_s: longest wait; the first question is asked however short it is.
    """
    start_s = now_s = running_s()
    next_look_s, pause_s = start_s + LIVENESS_PERIOD_S, MIN_SLEEP_S
    while (found := ready()) is None:
        is_late = now_s - start_s >= timeout_s
        if is_late or now_s >= next_look_s:
            next_look_s = now_s + LIVENESS_PERIOD_S
            if (error := check()) is not None:
                if (found := ready()) is None:
                    raise error
                return found
        if is_late:
            return None
        if now_s - start_s < SPIN_S:
            os.sched_yield()
        else:
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, MAX_SLEEP_S)
        now_s = running_s()
    return found
