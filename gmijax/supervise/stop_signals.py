"""Signals that ask a job to save and end, and how urgent they are."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
"""What asks a job to save and end: Ctrl-C, batch systems, a terminal that is closed.

The controller handles them; a GMI with a lifeline ignores them."""

_AGAIN_S: Final = 1.0


class StopSignals:
    """Signals that ask for an end: the first one, and the same one again a second later or more.

    A program such as `timeout` sends its signal twice at once, and a batch system sends others
    before the last: these do not count as a second request.

    Attributes:
      requests: how many have come that count: the first asks to save and end, the second to end.
      name: of the last request that counted: `Ctrl-C`, or a signal's name.
      are_urgent: whether one of them was not Ctrl-C: its sender may soon kill the job.
    """

    def __init__(self) -> None:
        self.requests = 0
        self.name = ""
        self.are_urgent = False
        self._last_s: dict[int, float] = {}

    @property
    def have_come(self) -> bool:
        """Whether an end was asked for."""
        return self.requests > 0

    def handle(self, number: int, _: FrameType | None = None) -> None:
        """The signal handler."""
        now_s = time.monotonic()
        is_again = now_s - self._last_s.get(number, now_s) >= _AGAIN_S
        if is_again or not self._last_s:
            self.requests += 1
            self.name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self.are_urgent |= number != signal.SIGINT
        self._last_s[number] = now_s


@contextmanager
def stop_signals() -> Iterator[StopSignals]:
    """Handles `STOP_SIGNALS` while it is entered; restores the handlers before them."""
    signals = StopSignals()
    # Python delivers signals to the main thread only; elsewhere they are the caller's business.
    is_main = threading.current_thread() is threading.main_thread()
    # What was ignored when the job was started, by nohup for one, stays ignored.
    previous = {
        number: signal.signal(number, signals.handle)
        for number in STOP_SIGNALS
        if is_main and signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield signals
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
