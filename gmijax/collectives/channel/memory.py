"""Channels through shared memory: pipes between processes of one host."""

from __future__ import annotations

from collections.abc import Sequence

from gmijax.collectives.pipe import Bytes, Message, PipeReader, PipeWriter
from gmijax.collectives.pipe_block import PipeBlock
from gmijax.errors import GmijaxError


class MemoryOutlet:
    """The way to trainer `peer`; see `Outlet`. All agents' loads are seen."""

    def __init__(self, block: PipeBlock, peer: int) -> None:
        self.peer = peer
        self._block = block
        self._writer = PipeWriter(block, peer)
        self.max_message_bytes = self._writer.max_message_bytes

    @property
    def sent_items(self) -> int:
        """See `Outlet`."""
        return self._writer.progress.items

    @property
    def messages(self) -> int:
        """Messages committed since the way exists."""
        return self._writer.progress.messages

    @property
    def outstanding_messages(self) -> int:
        """Messages that the trainer has not released."""
        return self._writer.outstanding_messages

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """See `Outlet`."""
        return self._writer.try_reserve(sizes)

    def commit(self, *, tag: int = 0, items: int = 1) -> None:
        """See `Outlet`."""
        self._writer.commit(tag=tag, items=items)

    def load_bytes(self) -> int:
        """See `Outlet`."""
        return self._block.outstanding_bytes(self.peer)

    def occupancy(self) -> float:
        """See `Outlet`."""
        return self._writer.outstanding_bytes / self._writer.capacity_bytes

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Outlet`."""
        return self._block.why_lost((self.peer,), operation, step)

    def close(self) -> None:
        """See `Outlet`."""
        self._writer.close()


class MemoryInlet:
    """The way from agent `peer`; see `Inlet`."""

    def __init__(self, block: PipeBlock, peer: int) -> None:
        self.peer = peer
        self._block = block
        self._reader = PipeReader(block, peer)

    def try_get(self) -> Message | None:
        """See `Inlet`."""
        return self._reader.try_get()

    def release(self) -> None:
        """See `Inlet`."""
        self._reader.release()

    def occupancy(self) -> float:
        """See `Inlet`."""
        return self._reader.outstanding_bytes / self._block.capacity_bytes

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Inlet`."""
        return self._block.why_lost((self.peer,), operation, step)

    def close(self) -> None:
        """See `Inlet`."""
        self._reader.close()
