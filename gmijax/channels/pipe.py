"""Bytes from one process to one other through shared memory: bounded, in order, checksummed.

A pipe has one writer and one reader, each used by one thread. The writer fills the memory that
`reserve` gives it, or has `put` do it, and commits; the reader gets views of that same memory
and releases them. So every byte is copied once, by the writer, and a message made of several
buffers needs no buffer of its own.

    fd = create_pipes(world_size=2, capacity_bytes=2**20)      # in the controller

    writer = PipeWriter(PipeBlock(fd, rank=0), peer=1)         # in rank 0
    writer.put([array, other], timeout_s=5.0)

    reader = PipeReader(PipeBlock(fd, rank=1), peer=0)         # in rank 1
    first, second = reader.get(timeout_s=5.0)                  # read-only views [bytes] uint8
    reader.release()

What is in the ring: `pipe_format.py`; the checksum: `docs/channels.md`; the order of memory
accesses: `docs/decisions/shared-memory-exchange.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy.typing as npt

from gmijax.channels.pipe_block import PipeBlock
from gmijax.channels.pipe_format import (
    ALIGNMENT,
    GAP,
    Bytes,
    Damaged,
    message_bytes,
    read_header,
    read_parts,
    seal_gap,
    seal_message,
    split_parts,
)
from gmijax.collectives.shared_memory import Fence
from gmijax.collectives.waits import wait_until
from gmijax.errors import CollectiveError, CollectiveTimeout, GmijaxError, PipeClosed

Message: TypeAlias = tuple[Bytes, ...]
"""Its parts: read-only views [bytes] uint8 of the ring, aligned to 64 bytes; valid until
`PipeReader.release` or the next `get`."""


class PipeWriter:
    """The writing end of the pipe from `block.rank` to `peer`.

    A message may take half of the ring (`max_message_bytes`): then there is space for it, at
    the latest, when the reader has released all before it. `messages` counts those committed.

    Raises:
      CollectiveError: not enough shared memory.
    """

    def __init__(self, block: PipeBlock, peer: int) -> None:
        block.allocate(peer)
        self.peer = peer
        self.max_message_bytes = block.capacity_bytes // 2 // ALIGNMENT * ALIGNMENT
        self.messages = 0
        self._block = block
        self._own, self._reader, self._ring = block.pipe(block.rank, peer)
        self._read_position = self._reader["position"]
        self._position = 0
        self._fence = Fence()
        # Offset of the next message in the ring, bytes skipped before it, its size, its parts'.
        self._reserved: tuple[int, int, int, tuple[int, ...]] | None = None

    @property
    def outstanding_bytes(self) -> int:
        """Bytes committed and not yet released by the reader."""
        return self._position - self._read_position.item(0)

    @property
    def released_messages(self) -> int:
        """Messages that the reader has released."""
        released = self._reader["messages"].item(0)
        self._fence()  # What it had read of them may be overwritten now.
        return released

    def occupancy(self) -> float:
        """How full the pipe is, 0 to 1."""
        return self.outstanding_bytes / self._block.capacity_bytes

    def load_bytes(self) -> int:
        """Bytes on the way to the reader from all ranks."""
        return self._block.outstanding_bytes(self.peer)

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the reader will never read again, None if it may."""
        return self._block.why_lost(self.peer, operation, step)

    def put(self, parts: Sequence[npt.NDArray[Any]], timeout_s: float) -> None:
        """Writes one message made of arrays with any strides, when there is space.

        Raises:
          CollectiveTimeout: there was no space in time.
          PeerLost: the reader's process is gone, and there is no space.
          PipeClosed, CollectiveError: see `try_reserve`.
        """
        is_put = wait_until(
            lambda: self.try_put(parts) or None,
            lambda: self.why_lost("put", self.messages),
            timeout_s,
        )
        if is_put is None:
            rank, step = self._block.rank, self.messages
            raise CollectiveTimeout(rank, (self.peer,), "put", step, timeout_s)

    def try_put(self, parts: Sequence[npt.NDArray[Any]]) -> bool:
        """As `put`, but without waiting: whether there was space."""
        if (views := self.try_reserve([part.nbytes for part in parts])) is None:
            return False
        for view, part in zip(views, parts, strict=True):
            view.view(part.dtype).reshape(part.shape)[...] = part
        self.commit()
        return True

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """Memory for parts of so many bytes, to be filled before `commit`; None if there is none.

        It is aligned to 64 bytes. A reservation that is never committed is dropped by the next.

        Raises:
          PipeClosed: the reader has closed the pipe.
          CollectiveError: larger than `max_message_bytes`.
        """
        length, capacity = message_bytes(sizes), self._block.capacity_bytes
        if length > self.max_message_bytes:
            raise CollectiveError(
                f"GMI {self._block.rank}: a message of {length} bytes to GMI {self.peer}, "
                f"at most {self.max_message_bytes}"
            )
        if self._reader["closed"].item(0):
            raise PipeClosed(self._block.rank, self.peer, "put")
        start = self._position % capacity
        gap = capacity - start if start + length > capacity else 0
        if self.outstanding_bytes + gap + length > capacity:
            return None
        self._fence()  # What the reader released was read before it is overwritten.
        begin = 0 if gap else start
        self._reserved = begin, gap, length, tuple(sizes)
        return split_parts(self._ring, begin, sizes)

    def commit(self) -> None:
        """Hands the reserved message to the reader."""
        if self._reserved is None:
            raise CollectiveError(f"GMI {self._block.rank}: commit without reserve")
        (begin, gap, length, sizes), self._reserved = self._reserved, None
        if gap:
            start = self._position % self._block.capacity_bytes
            seal_gap(self._ring, start, gap, self.messages)
        seal_message(self._ring, begin, sizes, self.messages)
        self.messages += 1
        self._position += gap + length
        self._fence()
        self._own["position"][0] = self._position

    def close(self) -> None:
        """Marks the end of the messages for the reader. Idempotent."""
        self._fence()
        self._own["closed"][0] = 1


class PipeReader:
    """The reading end of the pipe from `peer` to `block.rank`.

    `messages` counts those released.
    """

    def __init__(self, block: PipeBlock, peer: int) -> None:
        self.peer = peer
        self.messages = 0
        self._block = block
        self._writer, self._own, self._ring = block.pipe(peer, block.rank)
        self._written_position = self._writer["position"]
        self._position = 0
        self._next_position: int | None = None
        self._fence = Fence()

    @property
    def outstanding_bytes(self) -> int:
        """Bytes committed by the writer and not yet released."""
        return self._written_position.item(0) - self._position

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the writer will never write again, None if it may."""
        return self._block.why_lost(self.peer, operation, step)

    def get(self, timeout_s: float) -> Message:
        """Waits for the next message; releases the last one.

        Raises:
          CollectiveTimeout: none came in time.
          PeerLost: the pipe is empty and the writer's process is gone.
          PipeClosed: the pipe is empty and the writer has closed it.
          CollectiveError: the message is damaged.
        """
        self.release()
        message = wait_until(self.try_get, lambda: self.why_lost("get", self.messages), timeout_s)
        if message is None:
            rank, step = self._block.rank, self.messages
            raise CollectiveTimeout(rank, (self.peer,), "get", step, timeout_s)
        return message

    def try_get(self) -> Message | None:
        """As `get`, but without waiting: None if there is no message."""
        self.release()
        if not self.outstanding_bytes:
            if not self._writer["closed"].item(0):
                return None
            self._fence()
            if not self.outstanding_bytes:
                raise PipeClosed(self._block.rank, self.peer, "get")
        self._fence()
        try:
            return self._read(self._position)
        except Damaged as error:
            raise CollectiveError(
                f"GMI {self._block.rank}: message {self.messages} from GMI {self.peer} "
                f"is damaged: {error}"
            ) from None

    def release(self) -> None:
        """Gives the memory of the last message back to the writer; its views end here."""
        if self._next_position is not None:
            self._position, self._next_position = self._next_position, None
            self.messages += 1
            self._fence()
            self._own["messages"][0] = self.messages
            self._own["position"][0] = self._position

    def close(self) -> None:
        """Makes the writer stop: nothing more is read. Idempotent."""
        self.release()
        self._own["closed"][0] = 1

    def _read(self, position: int) -> Message:
        ring = self._ring
        header = read_header(ring, position % len(ring), self.messages)
        if header.kind == GAP:
            position += header.length
            header = read_header(ring, position % len(ring), self.messages)
        self._next_position = position + header.length
        return read_parts(ring, position % len(ring), header)
