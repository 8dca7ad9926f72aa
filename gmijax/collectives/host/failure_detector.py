"""Finds which peer is dead or stuck when a rank has waited too long.

A rank that waits raises its `heartbeats` now and then. So at a timeout a peer that only waits too
is not mistaken for one that is stuck, wherever each of them waits. A rank that gives up records
the peer it waited for, its `suspect`, so that its own end is not taken for the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

from gmijax.clock import running_s
from gmijax.collectives.host.shared_block import SharedBlock
from gmijax.collectives.shared_memory import fence, process_of
from gmijax.errors import CollectiveTimeout, PeerLost

SILENCE_S = 0.7
"""A rank without a heartbeat for this long is not waiting: three heartbeats are missing."""


class FailureDetector:
    """One wait of one rank, from its start, in `operation`, which is call number `step`.

    Attributes:
      on_look: called at every `look`.
    """

    def __init__(self, block: SharedBlock, operation: str, step: int, timeout_s: float) -> None:
        self.on_look: Callable[[], None] = lambda: None
        self._block = block
        self._operation = operation
        self._step = step
        self._timeout_s = timeout_s
        self._start_s = self._clock_s = running_s()
        self._last_heartbeats: dict[int, tuple[int, float]] = {}

    @property
    def is_late(self) -> bool:
        """Whether the time is up."""
        return self._waited_s() >= self._timeout_s

    def look(self, missing: Callable[[], list[int]], *, while_unresponsive: bool = False) -> None:
        """Checks the ranks that are missing; to be called five times a second.

        Args:
          missing: ranks that have not arrived, read anew at every call.
          while_unresponsive: the time starts anew while all missing ranks send heartbeats.

        Raises:
          PeerLost: the process of one of them is gone.
          CollectiveTimeout: the time is up.
        """
        self._block.lines["heartbeats"][self._block.rank] += 1
        self.on_look()
        self._check_alive(missing)
        self._listen()
        left = missing()
        if while_unresponsive and left and not self.unresponsive(left):
            self._clock_s = running_s()
        elif left and self.is_late:
            self.give_up(left)

    def give_up(self, missing: list[int]) -> NoReturn:
        """Raises CollectiveTimeout for those of `missing` that do not wait themselves.

        A rank that has given up and is still ending is unresponsive too, and not the cause.
        """
        peers = self.unresponsive(missing) or missing
        self._raise_timeout([peer for peer in peers if not self._block.suspect[peer]] or peers)

    def unresponsive(self, missing: list[int]) -> list[int]:
        """Those of `missing` without a recent heartbeat, which do not wait themselves."""
        since_s, never = running_s() - SILENCE_S, (0, self._start_s)
        return [peer for peer in missing if self._last_heartbeats.get(peer, never)[1] < since_s]

    def _check_alive(self, missing: Callable[[], list[int]]) -> None:
        gone = [peer for peer in missing() if self._is_gone(peer)]
        # One may have arrived and ended, in this order, since it was found missing.
        gone = [peer for peer in missing() if peer in gone]
        if not gone:
            return
        suspect = self._block.suspect.item
        for peer in gone:
            if not suspect(peer):
                self._raise_lost(peer)
        cause = suspect(gone[0]) - 1
        if cause in (self._block.rank, *gone) or self._is_gone(cause):
            self._raise_lost(gone[0] if cause == self._block.rank else cause)
        self._raise_timeout([cause])

    def _waited_s(self) -> float:
        return running_s() - self._clock_s

    def _is_gone(self, peer: int) -> bool:
        # A rank that has not attached cannot be distinguished from one that is still starting.
        attached = self._block.lines["sequence"][peer]
        fence()  # Its process was noted before.
        return bool(attached) and not process_of(self._block.lines[peer]).is_running()

    def _listen(self) -> None:
        now_s = running_s()
        for peer, heartbeats in enumerate(self._block.lines["heartbeats"].tolist()):
            if self._last_heartbeats.get(peer, (None,))[0] != heartbeats:
                self._last_heartbeats[peer] = heartbeats, now_s

    def _raise_lost(self, peer: int) -> NoReturn:
        self._block.suspect[self._block.rank] = peer + 1
        own, other = (self._block.ids[rank] for rank in (self._block.rank, peer))
        raise PeerLost(own, other, self._operation, self._step)

    def _raise_timeout(self, missing: list[int]) -> NoReturn:
        self._block.suspect[self._block.rank] = missing[0] + 1
        waited_s = min(round(self._waited_s(), 2), self._timeout_s)
        own, *others = (self._block.ids[rank] for rank in (self._block.rank, *missing))
        raise CollectiveTimeout(own, tuple(others), self._operation, self._step, waited_s)
