"""Migrator: which trainer gets the next transfer (paper, section 4.2).

A trainer on the agent's own GPU gets it directly. If there is none, experience is gathered by
channel (the compressor's transfers) and goes to the trainer with the least outstanding work.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Generic, TypeAlias, TypeVar

from gmijax.channels.pipe import Bytes, PipeWriter
from gmijax.channels.tcp_channel import RemoteWriter
from gmijax.collectives.waits import LIVENESS_PERIOD_S
from gmijax.errors import GmijaxError, PeerLost, PipeClosed

ChannelWriter: TypeAlias = PipeWriter | RemoteWriter
"""The way from this agent to trainer `peer`: in shared memory, or over TCP."""

W = TypeVar("W", bound=ChannelWriter)


class Migrator(Generic[W]):
    """Routes the transfers of one agent over `writers`; `near` are ranks on the agent's GPU."""

    def __init__(self, writers: Sequence[W], near: Sequence[int]) -> None:
        self.writers = tuple(writers)
        self._candidates = [w for w in writers if w.peer in near] or list(writers)
        self._transfers = 0
        self._next_look_s = time.monotonic()

    def try_open(self, sizes: Sequence[int]) -> tuple[W, list[Bytes]] | None:
        """A writer for a transfer with parts of `sizes` bytes, and its memory; None: it is full.

        Raises:
          PipeClosed: a trainer has closed its end.
          PeerLost: one has, and the process of another is gone, which may be why.
        """
        for writer in self._by_load():
            try:
                views = writer.try_reserve(sizes)
            except PipeClosed as closed:
                error = self.why_lost()
                raise error if isinstance(error, PeerLost) else closed from None
            if views is not None:
                self._transfers += 1
                return writer, views
        return None

    def why_lost(self) -> GmijaxError | None:
        """Why some trainer will never read again, the dead first; None if all may."""
        asked = (writer.why_lost("send", self._transfers) for writer in self.writers)
        found = [error for error in asked if error is not None]
        dead = (error for error in found if isinstance(error, PeerLost))
        return next(dead, found[0] if found else None)

    def check(self) -> None:
        """Looks at all trainers, five times a second at most; raises what `why_lost` finds."""
        now_s = time.monotonic()
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + LIVENESS_PERIOD_S
            if (error := self.why_lost()) is not None:
                raise error

    def occupancy(self) -> float:
        """How full the fullest way is, 0 to 1."""
        return max(writer.occupancy() for writer in self.writers)

    def least_occupancy(self) -> float:
        """How full the emptiest way is that the next transfer may take, 0 to 1."""
        return min(writer.occupancy() for writer in self._candidates)

    def close(self) -> None:
        """Marks the end of the transfers for all trainers."""
        for writer in self.writers:
            writer.close()

    def _by_load(self) -> list[W]:
        """The least loaded first; among equals in turn, so that idle trainers get the same."""
        count = len(self._candidates)
        if count == 1:
            return self._candidates
        turn = self._transfers % count
        in_turn = self._candidates[turn:] + self._candidates[:turn]
        return sorted(in_turn, key=lambda writer: writer.load_bytes())
