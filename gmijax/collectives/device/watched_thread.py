"""A thread for calls that may never come back.

A collective of a GPU library waits for a peer that died or hangs, and Python cannot
interrupt it. So such a call runs in this thread, and the rank's own thread looks at the peers.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar

T = TypeVar("T")


class WatchedThread:
    """One daemon thread that runs one call at a time.

    A call that its owner gives up is left alone, and with it the thread. The process can still
    raise and report, but it ends without the shutdown of the libraries that the thread is stuck
    in, which could wait for ever (exit code 1). Until then memory and programs of its GPU must
    stay: CUDA frees none while a kernel there waits.

    Attributes:
      is_stuck: whether a call has been given up.
    """

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self.is_stuck = False
        threading.Thread(target=self._serve, name="step", daemon=True).start()

    def run(self, function: Callable[[], T], wait: Callable[[threading.Event], object]) -> T:
        """Returns what `function` returns, or raises what it raises.

        Args:
          function: runs in the watched thread's thread.
          wait: returns when the event is set, or raises, which gives the call up.
        """
        call: Future[T] = Future()
        done = threading.Event()
        call.add_done_callback(lambda _: done.set())
        self._calls.put((call, function))
        try:
            wait(done)
        except BaseException:
            self._give_up()
            raise
        return call.result()

    def close(self) -> None:
        """Ends the thread; calling it twice is fine."""
        self._calls.put(None)

    def _serve(self) -> None:
        while (given := self._calls.get()) is not None:
            call, function = given
            try:
                call.set_result(function())
            except BaseException as error:  # Raised again in the thread that waits.
                call.set_exception(error)
            del given, call, function  # Nothing of it may outlive the caller's interest.

    def _give_up(self) -> None:
        if not self.is_stuck:
            self.is_stuck = True
            # Runs first of all such functions, because they run in reverse order.
            atexit.register(end_at_once)


def end_at_once() -> None:
    """Ends this process with exit code 1; for `atexit`, where libraries would wait for peers."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1)
