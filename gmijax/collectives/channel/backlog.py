"""Back-pressure: what an agent does with experience for which there is no room."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

from gmijax.collectives.channel.dispenser import Piece
from gmijax.collectives.waits import wait_until
from gmijax.errors import GmijaxError


class Taker(Protocol):
    """What takes pieces: a `Compressor`, or the uni-channel in its place."""

    def try_add(self, piece: Piece) -> bool:
        """Takes `piece`, or says that there is no room; then the same piece must come again."""
        ...


class Block:
    """Waits for room. Nothing is ever dropped.

    Args:
      taker: where pieces go.
      why_lost: says who will never make room again.

    Attributes:
      dropped: 0.
      waited_s: so far.
    """

    def __init__(self, taker: Taker, why_lost: Callable[[], GmijaxError | None]) -> None:
        self.dropped = 0
        self.waited_s = 0.0
        self._taker = taker
        self._why_lost = why_lost
        self._todo: deque[Piece] = deque()

    def add(self, pieces: Iterable[Piece], timeout_s: float) -> bool:
        """Whether all pieces were taken in time; if not, the next call goes on with the rest."""
        if not self._todo:
            self._todo.extend(pieces)
        deadline_s = time.monotonic() + timeout_s
        while self._todo:
            piece = self._todo[0]
            if not self._taker.try_add(piece) and not self._wait(piece, deadline_s):
                return False
            self._todo.popleft()
        return True

    def drain(self, timeout_s: float) -> bool:
        """Whether nothing waits any more."""
        return self.add((), timeout_s)

    def _wait(self, piece: Piece, deadline_s: float) -> bool:
        started_s = time.monotonic()
        try:
            took = wait_until(
                lambda: self._taker.try_add(piece) or None, self._why_lost, deadline_s - started_s
            )
        finally:
            self.waited_s += time.monotonic() - started_s
        return took is not None


class DropOldest:
    """Never waits. What finds no room is copied and queued; a full queue loses its oldest.

    What is in shared memory already is a trainer's: only what waits on this side is dropped.

    Args:
      taker: where pieces go.
      why_lost: says who will never make room again.
      max_waiting: most pieces in the queue.

    Attributes:
      dropped: pieces so far.
      waited_s: only at the end, in `drain`.
    """

    def __init__(
        self, taker: Taker, why_lost: Callable[[], GmijaxError | None], max_waiting: int
    ) -> None:
        self.dropped = 0
        self.waited_s = 0.0
        self._taker = taker
        self._why_lost = why_lost
        self._max_waiting = max_waiting
        self._queue: deque[Piece] = deque()

    def add(self, pieces: Iterable[Piece], timeout_s: float) -> bool:
        """Takes all pieces at once; always True."""
        del timeout_s
        for piece in pieces:
            self._pass_on()
            if not self._queue and self._taker.try_add(piece):
                continue
            self._queue.append(piece.copy())
            if len(self._queue) > self._max_waiting:
                self._queue.popleft()
                self.dropped += 1
        return True

    def drain(self, timeout_s: float) -> bool:
        """Whether what was queued could be passed on in time; the rest is dropped."""
        started_s = time.monotonic()
        try:
            wait_until(lambda: self._pass_on() or None, self._why_lost, timeout_s)
        finally:
            self.waited_s += time.monotonic() - started_s
            left = len(self._queue)
            self.dropped += left
            self._queue.clear()
        return not left

    def _pass_on(self) -> bool:
        while self._queue and self._taker.try_add(self._queue[0]):
            self._queue.popleft()
        return not self._queue
