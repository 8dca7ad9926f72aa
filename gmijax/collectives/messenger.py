"""Messages between the GMIs of a host: nested data over pipes in shared memory.

Sending is asynchronous: what does not fit into the pipe at once is copied, and a thread passes it
on piece by piece, so that GMIs which send to each other before they receive never block each
other, however large the messages. Receiving waits, with a timeout.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection
from typing import Any, Final, Protocol

import numpy as np

from gmijax.collectives.mailboxes import DATA, Inbox, Outbox, frames_of
from gmijax.collectives.pipe import PipeReader, PipeWriter
from gmijax.collectives.pipe_block import PipeBlock
from gmijax.collectives.waits import wait_until
from gmijax.errors import CollectiveTimeout, ConfigError, PeerLost, PipeClosed

MIN_CAPACITY_BYTES: Final = 1 << 18
"""Least capacity of the pipes, so that a frame fits."""


class Post(Protocol):
    """What keeps arrays where sender and receiver both reach them; see `DevicePost`."""

    @property
    def peers(self) -> Collection[int]:
        """Ranks that reach them."""
        ...

    def stow(self, array: Any, dst: int, released_frames: int) -> Any:
        """What travels to rank `dst` in an array's place, or None."""
        ...

    def sent(self, dst: int, frames: int) -> None:
        """What was stowed for `dst` is in use until it has released so many frames."""
        ...

    def holds(self, dst: int, released_frames: int) -> bool:
        """Whether something waits for `dst`, which has released so many frames."""
        ...

    def fetch(self, stowed: Any) -> Any:
        """The array again."""
        ...


class Messenger:
    """One rank's messages to all others, and theirs to it.

    Messages from one rank to another arrive in order, each tag in an order of its own. One
    thread only may use it.

    Args:
      block: this process's view of the pipes, of at least `MIN_CAPACITY_BYTES` each.
      timeout_s: longest wait for a message, unless `recv` says else.
      device: what keeps arrays on the GPU that ranks share; None: they go through the host.

    Attributes:
      rank: this rank.
      world_size: K, number of ranks.
    """

    def __init__(self, block: PipeBlock, timeout_s: float, device: Post | None = None) -> None:
        if block.capacity_bytes < MIN_CAPACITY_BYTES:
            raise ConfigError(
                f"capacity_bytes={block.capacity_bytes}: messages need {MIN_CAPACITY_BYTES}"
            )
        self.rank = block.rank
        self.world_size = block.world_size
        self._timeout_s = timeout_s
        self._block = block
        self._device = device
        # Half of the longest message of the pipe, so that a frame can wait behind another.
        self._frame_bytes = block.capacity_bytes // 4
        self._outboxes: dict[int, Outbox] = {}
        self._readers: dict[int, PipeReader] = {}
        self._inboxes: dict[int, Inbox] = {}

    def send(self, tree: Any, dst: int, *, tag: int = DATA) -> None:
        """Sends `tree` to rank `dst` and does not wait for it; the caller may change it then.

        Args:
          tree: nested data with arrays, see `gmijax.collectives.trees`.
          dst: a rank; sending to oneself is fine.
          tag: `DATA` or `COLLECTIVE`.

        Raises:
          ConfigError: no such rank.
          PeerLost: its process is gone, and what was sent before could not be passed on.
          CollectiveTimeout: `MAX_WAITING_BYTES` wait already, for the whole of `timeout_s`.
        """
        self._check(dst, "dst")
        if dst == self.rank:
            for frame in frames_of(tree, tag, self._frame_bytes):
                self._inbox(dst).feed(frame)
            return
        if dst not in self._outboxes:
            self._outboxes[dst] = Outbox(PipeWriter(self._block, dst), self.rank)
        outbox = self._outboxes[dst]
        frames = frames_of(tree, tag, self._frame_bytes, self._stow(dst))
        outbox.post(frames, self._timeout_s)
        if self._device is not None:
            self._device.sent(dst, outbox.frames)

    def recv(self, src: int, *, tag: int = DATA, timeout_s: float | None = None) -> Any:
        """Returns the next message with this tag from rank `src`; its arrays are the caller's.

        After a timeout the same message can be waited for again.

        Raises:
          ConfigError: no such rank.
          PeerLost: its process is gone, and has left no message.
          CollectiveTimeout: none came in time.
        """
        self._check(src, "src")
        inbox = self._inbox(src)
        allowed_s = self._timeout_s if timeout_s is None else timeout_s
        deadline_s = time.monotonic() + allowed_s
        while not inbox.ready[tag]:
            if src == self.rank:  # Nobody else would send it.
                raise CollectiveTimeout(self.rank, (src,), "recv", inbox.received, 0.0)
            reader = self._reader(src)
            try:
                message = reader.get(max(0.0, deadline_s - time.monotonic()))
            except CollectiveTimeout:
                step = inbox.received
                raise CollectiveTimeout(self.rank, (src,), "recv", step, allowed_s) from None
            except PeerLost:
                raise PeerLost(self.rank, src, "recv", inbox.received) from None
            inbox.feed(message.parts)
            # What stayed on the GPU is copied by now: its place is free with the frame.
            reader.release()
        return inbox.ready[tag].popleft()

    def has_message(self, src: int, *, tag: int = DATA) -> bool:
        """Whether `recv` would return at once."""
        with contextlib.suppress(PipeClosed):
            self._take(src)
        return bool(self._inbox(src).ready[tag])

    def flush(self, timeout_s: float | None = None) -> None:
        """Waits until all that was sent lies in shared memory, where it outlives this process.

        What stays on the GPU does not: see `settle`.

        Raises:
          PeerLost: a receiver is gone, and has not taken all.
          CollectiveTimeout: receivers have not made room in time; names them.
        """
        allowed_s = self._timeout_s if timeout_s is None else timeout_s
        deadline_s = time.monotonic() + allowed_s
        late = [
            dst
            for dst, outbox in self._outboxes.items()
            if not outbox.wait_until_empty(deadline_s - time.monotonic())
        ]
        if late:
            raise CollectiveTimeout(self.rank, tuple(late), "flush", 0, allowed_s)

    def settle(self, timeout_s: float) -> bool:
        """Whether all that stays on the GPU has been received within `timeout_s`.

        It goes with this process, which must not end before. What others have sent is taken
        meanwhile, so that two that end do not wait for each other.
        """
        return wait_until(self._is_settled, lambda: None, timeout_s) is not None

    def _stow(self, dst: int) -> Callable[[Any], Any]:
        device = self._device
        if device is None:
            return lambda _: None
        released = self._released(dst)
        return lambda value: device.stow(value, dst, released)

    def _is_settled(self) -> bool | None:
        device = self._device
        if device is None:
            return True
        for peer in device.peers:
            with contextlib.suppress(PipeClosed):
                self._take(peer)
        waiting = (peer for peer in device.peers if device.holds(peer, self._released(peer)))
        is_lost = (self._block.why_lost((peer,), "settle", 0) is not None for peer in waiting)
        return all(is_lost) or None

    def _take(self, src: int) -> None:
        """Takes all frames that rank `src` has sent by now."""
        reader = self._reader(src)
        while (message := reader.try_get()) is not None:
            self._inbox(src).feed(message.parts)
            reader.release()

    def _released(self, dst: int) -> int:
        """How many frames rank `dst` has released so far."""
        return self._block.read(self.rank, dst).messages

    def _check(self, rank: int, what: str) -> None:
        if not (isinstance(rank, int | np.integer) and 0 <= rank < self.world_size):
            raise ConfigError(f"{what}={rank!r}: allowed are GMIs 0 to {self.world_size - 1}")

    def _reader(self, src: int) -> PipeReader:
        if src not in self._readers:
            self._readers[src] = PipeReader(self._block, src)
        return self._readers[src]

    def _inbox(self, src: int) -> Inbox:
        fetch = None if self._device is None else self._device.fetch
        return self._inboxes.setdefault(src, Inbox(fetch))
