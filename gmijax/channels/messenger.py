"""Messages between the GMIs of a host: nested data over pipes in shared memory.

Sending is asynchronous: what does not fit into the pipe at once is copied, and a thread passes it
on piece by piece, so that GMIs which send to each other before they receive never block each
other, however large the messages. Receiving waits, with a timeout.
"""

from __future__ import annotations

import contextlib
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gmijax.channels.mailboxes import DATA, Inbox, Outbox, frames_of
from gmijax.channels.pipe import PipeReader, PipeWriter
from gmijax.channels.pipe_block import PipeBlock
from gmijax.clock import running_s
from gmijax.collectives.waits import wait_until
from gmijax.errors import CollectiveTimeout, ConfigError, PipeClosed

if TYPE_CHECKING:
    from gmijax.channels.device_arrays import DeviceBuffers

MIN_CAPACITY_BYTES: Final = 1 << 18
"""Least capacity of the pipes, so that a frame fits."""


class Messenger:
    """One rank's messages to all others, and theirs to it.

    Messages from one rank to another arrive in order, each tag in an order of its own. One
    thread only may use it. Where there is no `device`, all arrays go through the host.
    """

    def __init__(
        self, block: PipeBlock, timeout_s: float, device: DeviceBuffers | None = None
    ) -> None:
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
        """Sends nested data to a rank and does not wait for it; the caller may change it then.

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
        outbox, device = self._outboxes[dst], self._device
        if device is None:
            outbox.post(frames_of(tree, tag, self._frame_bytes), self._timeout_s)
            return
        put = partial(device.try_put, dst=dst, released=outbox.released_frames)
        outbox.post(frames_of(tree, tag, self._frame_bytes, put), self._timeout_s)
        device.mark_sent(dst, outbox.frames)

    def recv(self, src: int, *, tag: int = DATA, timeout_s: float | None = None) -> Any:
        """Returns the next message with this tag from rank `src`; its arrays are the caller's.

        Raises:
          ConfigError: no such rank.
          PeerLost: its process is gone, and has left no message.
          CollectiveTimeout: none came in time; it can be waited for again.
        """
        self._check(src, "src")
        inbox = self._inbox(src)
        # No other rank sends to this one's own queue.
        allowed_s = self._timeout_s if timeout_s is None else timeout_s
        allowed_s = 0.0 if src == self.rank else allowed_s
        arrived = wait_until(
            lambda: self._read(src, tag) or None,
            lambda: self._block.why_lost(src, "recv", inbox.received),
            allowed_s,
        )
        if arrived is None:
            raise CollectiveTimeout(self.rank, (src,), "recv", inbox.received, allowed_s)
        return inbox.ready[tag].popleft()

    def has_message(self, src: int, *, tag: int = DATA) -> bool:
        """Whether `recv` would return at once."""
        with contextlib.suppress(PipeClosed):
            self._read(src)
        return bool(self._inbox(src).ready[tag])

    def flush(self) -> None:
        """Waits until all that was sent lies in shared memory, where it outlives this process.

        What stays on the GPU does not: see `drain`.

        Raises:
          PeerLost: a receiver is gone, and has not taken all.
          CollectiveTimeout: receivers have not freed space in time; names them.
        """
        deadline_s = running_s() + self._timeout_s
        late = [
            dst
            for dst, outbox in self._outboxes.items()
            if not outbox.wait_until_empty(deadline_s - running_s())
        ]
        if late:
            raise CollectiveTimeout(self.rank, tuple(late), "flush", 0, self._timeout_s)

    def drain(self, timeout_s: float) -> bool:
        """Whether all that stays on the GPU, and goes with this process, was received in time.

        What others have sent is taken meanwhile, so that two that end do not wait for each other.
        """
        return wait_until(lambda: self._is_drained() or None, lambda: None, timeout_s) is not None

    def _is_drained(self) -> bool:
        if self._device is None:
            return True
        for peer in self._device.peers:
            with contextlib.suppress(PipeClosed):
                self._read(peer)
        waiting = (
            peer
            for peer, outbox in self._outboxes.items()
            if self._device.holds(peer, outbox.released_frames)
        )
        return all(self._block.why_lost(peer, "drain", 0) is not None for peer in waiting)

    def _read(self, src: int, tag: int | None = None) -> bool:
        """Takes what rank `src` has sent, up to a message with `tag`; whether there is one."""
        ready = self._inbox(src).ready
        if src == self.rank:
            return tag is not None and bool(ready[tag])
        if src not in self._readers:
            self._readers[src] = PipeReader(self._block, src)
        reader = self._readers[src]
        while tag is None or not ready[tag]:
            if (frame := reader.try_get()) is None:
                return False
            self._inbox(src).feed(frame)
            # What stayed on the GPU is copied by now: its memory is free with the frame.
            reader.release()
        return True

    def _check(self, rank: int, what: str) -> None:
        if not (isinstance(rank, int | np.integer) and 0 <= rank < self.world_size):
            raise ConfigError(f"{what}={rank!r}: there are GMIs 0 to {self.world_size - 1}")

    def _inbox(self, src: int) -> Inbox:
        get = None if self._device is None else self._device.get
        return self._inboxes.setdefault(src, Inbox(get))
