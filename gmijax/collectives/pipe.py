"""Bytes from one process to one other through shared memory: bounded, in order, checksummed.

A pipe has one writer and one reader, each used by one thread. The writer fills the memory that
`reserve` gives it, or has `put` do it, and commits; the reader gets views of that same memory
and releases them. So every byte is copied once, by the writer, and a message made of several
buffers needs no buffer of its own.

    fd = create_pipes(world_size=2, capacity_bytes=2**20)      # in the controller

    block = PipeBlock.attach(fd, 0, 2, 2**20)                  # in rank 0
    writer = PipeWriter(block, dst=1)
    writer.put([b"name", array], timeout_s=5.0)

    block = PipeBlock.attach(fd, 1, 2, 2**20)                  # in rank 1
    reader = PipeReader(block, src=0)
    name, values = reader.get(timeout_s=5.0).parts             # read-only views [bytes] uint8
    reader.release()

What is in the ring: `gmijax.collectives.pipe_format`. What the checksums cost and what they find:
`docs/channels.md`. Which order of memory accesses this relies on:
`docs/decisions/shared-memory-exchange.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.collectives.pipe_block import PipeBlock, Progress, progress_of
from gmijax.collectives.pipe_format import (
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
from gmijax.collectives.waits import Fence, wait_until
from gmijax.errors import CollectiveError, CollectiveTimeout, PipeClosed

Part: TypeAlias = bytes | bytearray | memoryview | npt.NDArray[Any]
"""What `put` takes: bytes of any kind, or an array of numbers with whatever strides."""


class Message(NamedTuple):
    """What came out of a pipe.

    Attributes:
      sequence: 0 for the first message of the pipe, then one up each.
      tag: what the writer gave.
      items: what the writer gave.
      parts: read-only views [bytes] uint8 of the ring, aligned to 64 bytes; valid until
        `PipeReader.release` or the next `get`.
    """

    sequence: int
    tag: int
    items: int
    parts: tuple[Bytes, ...]


class PipeWriter:
    """The writing end of the pipe from `block.rank` to `dst`.

    A message may take half of the ring, see `max_message_bytes`: then there is room for it, at
    the latest, when the reader has released all before it.

    Args:
      block: this process's view of the pipes.
      dst: rank of the reader.

    Raises:
      CollectiveError: not enough shared memory.
    """

    def __init__(self, block: PipeBlock, dst: int) -> None:
        block.allocate(block.rank, dst)
        self.dst = dst
        self.capacity_bytes = block.capacity_bytes
        self.max_message_bytes = block.capacity_bytes // 2 // ALIGNMENT * ALIGNMENT
        self._block = block
        self._memory = block.memory(block.rank, dst)
        self._position = self._memory.writer["position"]
        self._read_position = self._memory.reader["position"]
        self._memory.writer["closed"][0] = 0
        self.progress = progress_of(self._memory.writer)
        self._fence = Fence()
        self._open: _Reservation | None = None

    @property
    def outstanding_bytes(self) -> int:
        """Bytes committed and not yet released by the reader."""
        return self.progress.position - self._read_position.item(0)

    @property
    def outstanding_messages(self) -> int:
        """Messages committed and not yet released by the reader."""
        return self.progress.messages - progress_of(self._memory.reader).messages

    def put(
        self, parts: Sequence[Part], timeout_s: float, *, tag: int = 0, items: int = 1
    ) -> None:
        """Writes one message made of `parts`, when there is room.

        Raises:
          CollectiveTimeout: there was no room in time.
          PeerLost: the reader's process is gone, and there is no room.
          PipeClosed: the reader has closed the pipe.
          CollectiveError: larger than `max_message_bytes`.
        """
        self._fill(self.reserve([_size(part) for part in parts], timeout_s), parts, tag, items)

    def try_put(self, parts: Sequence[Part], *, tag: int = 0, items: int = 1) -> bool:
        """As `put`, but without waiting: whether there was room."""
        views = self.try_reserve([_size(part) for part in parts])
        if views is not None:
            self._fill(views, parts, tag, items)
        return views is not None

    def reserve(self, sizes: Sequence[int], timeout_s: float) -> list[Bytes]:
        """Memory for the parts of the next message, to be filled before `commit`.

        A reservation that is never committed is simply given up by the next one.

        Args:
          sizes: bytes of every part.
          timeout_s: longest wait for room.

        Returns:
          One array [bytes] uint8 for each part, aligned to 64 bytes.

        Raises:
          As `put`.
        """
        step = self.progress.messages
        views = wait_until(
            lambda: self.try_reserve(sizes),
            lambda: self._block.why_lost((self.dst,), "put", step),
            timeout_s,
        )
        if views is None:
            raise CollectiveTimeout(self._block.rank, (self.dst,), "put", step, timeout_s)
        return views

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """As `reserve`, but without waiting: None if there is no room."""
        length = message_bytes(sizes)
        if length > self.max_message_bytes:
            raise CollectiveError(
                f"rank {self._block.rank}: a message of {length} bytes to rank {self.dst}, "
                f"at most {self.max_message_bytes}"
            )
        if self._memory.reader["closed"].item(0):
            raise PipeClosed(self._block.rank, self.dst, "put")
        start = self.progress.position % self.capacity_bytes
        gap = self.capacity_bytes - start if start + length > self.capacity_bytes else 0
        if self.outstanding_bytes + gap + length > self.capacity_bytes:
            return None
        self._fence()  # What the reader released was read before it is overwritten.
        begin = 0 if gap else start
        self._open = _Reservation(begin, gap, length, tuple(sizes))
        return split_parts(self._memory.ring, begin, sizes)

    def commit(self, *, tag: int = 0, items: int = 1) -> None:
        """Hands the reserved message to the reader.

        Args:
          tag: a number for the reader, int64.
          items: how many things of the caller's are in the message; `progress` sums them.
        """
        if self._open is None:
            raise CollectiveError(f"rank {self._block.rank}: commit without reserve")
        done, (begin, gap, length, sizes) = self.progress, self._open
        self._open = None
        ring = self._memory.ring
        if gap:
            seal_gap(ring, done.position % self.capacity_bytes, gap, done.messages)
        seal_message(ring, begin, sizes, sequence=done.messages, items=items, tag=tag)
        self.progress = Progress(
            done.position + gap + length, done.messages + 1, done.items + items
        )
        _advance(self._memory.writer, self.progress, self._fence)

    def close(self) -> None:
        """Tells the reader that nothing more comes; calling it twice is fine."""
        self._fence()
        self._memory.writer["closed"][0] = 1

    def _fill(self, views: list[Bytes], parts: Sequence[Part], tag: int, items: int) -> None:
        for view, part in zip(views, parts, strict=True):
            if isinstance(part, np.ndarray):
                view.view(part.dtype).reshape(part.shape)[...] = part
            else:
                view[:] = np.frombuffer(part, np.uint8)
        self.commit(tag=tag, items=items)


class PipeReader:
    """The reading end of the pipe from `src` to `block.rank`.

    Args:
      block: this process's view of the pipes.
      src: rank of the writer.
    """

    def __init__(self, block: PipeBlock, src: int) -> None:
        self.src = src
        self._block = block
        self._memory = block.memory(src, block.rank)
        self._written_position = self._memory.writer["position"]
        self._memory.reader["closed"][0] = 0
        self.progress = progress_of(self._memory.reader)
        self._after: Progress | None = None
        self._fence = Fence()

    @property
    def outstanding_bytes(self) -> int:
        """Bytes committed by the writer and not yet released."""
        return self._written_position.item(0) - self.progress.position

    def get(self, timeout_s: float) -> Message:
        """Waits for the next message; releases the last one.

        Raises:
          CollectiveTimeout: none came in time.
          PeerLost: the pipe is empty and the writer's process is gone.
          PipeClosed: the pipe is empty and the writer has closed it.
          CollectiveError: the message is damaged.
        """
        self.release()
        step = self.progress.messages
        message = wait_until(
            self.try_get,
            lambda: self._block.why_lost((self.src,), "get", step),
            timeout_s,
        )
        if message is None:
            raise CollectiveTimeout(self._block.rank, (self.src,), "get", step, timeout_s)
        return message

    def try_get(self) -> Message | None:
        """As `get`, but without waiting: None if there is no message."""
        self.release()
        if not self.outstanding_bytes:
            if not self._memory.writer["closed"].item(0):
                return None
            self._fence()
            if not self.outstanding_bytes:
                raise PipeClosed(self._block.rank, self.src, "get")
        self._fence()
        try:
            return self._read(self.progress.position)
        except Damaged as error:
            raise CollectiveError(
                f"rank {self._block.rank}: message {self.progress.messages} from rank {self.src} "
                f"is damaged: {error}"
            ) from None

    def release(self) -> None:
        """Gives the memory of the last message back to the writer; its views end here."""
        if self._after is not None:
            self.progress, self._after = self._after, None
            _advance(self._memory.reader, self.progress, self._fence)

    def close(self) -> None:
        """Tells the writer that nothing more is wanted; calling it twice is fine."""
        self.release()
        self._memory.reader["closed"][0] = 1

    def _read(self, position: int) -> Message:
        ring, done = self._memory.ring, self.progress
        header = read_header(ring, position % len(ring), done.messages)
        if header.kind == GAP:
            position += header.length
            header = read_header(ring, position % len(ring), done.messages)
        parts = read_parts(ring, position % len(ring), header)
        self._after = Progress(
            position + header.length, done.messages + 1, done.items + header.items
        )
        return Message(header.sequence, header.tag, header.items, parts)


class _Reservation(NamedTuple):
    """Where the next message goes: offset in the ring, bytes skipped before it, its size."""

    begin: int
    gap: int
    length: int
    sizes: tuple[int, ...]


def _advance(end: npt.NDArray[np.void], progress: Progress, fence: Fence) -> None:
    """Publishes how far one end has come, after all that it has done."""
    end["record"][0, progress.messages % 2] = progress
    fence()
    end["position"][0] = progress.position


def _size(part: Part) -> int:
    return part.nbytes if isinstance(part, np.ndarray | memoryview) else len(part)
