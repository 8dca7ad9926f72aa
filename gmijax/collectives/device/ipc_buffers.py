"""Slots in memory of GPUs that several ranks map: all write theirs, and copy what is there."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gmijax.collectives.all_or_none import Group, all_or_none
from gmijax.collectives.device.device_memory import IPC_HANDLE_BYTES, DeviceMemory, NewMemory
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.shared_memory import fence
from gmijax.collectives.waits import wait_until
from gmijax.errors import PeerLost

if TYPE_CHECKING:
    from gmijax.collectives.device.cuda_queue import CudaQueue

CLOSE_S = 10.0
"""How long an owner waits for others that still use its memory; longer than a last step takes."""

FLOATS_PER_ROW_UNIT = 64
"""Slots begin at multiples of 256 bytes, as allocations of jax do."""


class IpcBuffers:
    """One rank's use of blocks of device memory with two slots for each member.

    The two slots are used in turn, so that members wait for each other once an exchange: a
    rank that writes a slot again has seen the flags of the exchange in between, which come
    after all that had been read of the one before.

    All ranks of the job make theirs together; on several nodes ranks are those in the node.

    Args:
      host: this rank's use of the shared block, to hand the blocks around.
      num_floats: length of a slot.
      members: ranks that have slots in each block; this one among them.
      owners: ranks that make the blocks which this one writes; the first one's is on its own GPU.
      new_memory: how the processes share a block.
      what: what is unavailable if this fails, for the message.

    Raises:
      DeviceMemoryUnavailable: there is no such memory here; on all ranks alike.
      PeerLost, CollectiveTimeout: as in the first call of a communicator.
    """

    def __init__(
        self,
        host: Group,
        num_floats: int,
        members: Sequence[int],
        owners: Sequence[int],
        new_memory: NewMemory,
        what: str,
    ) -> None:
        self._row_bytes = -(-num_floats // FLOATS_PER_ROW_UNIT) * FLOATS_PER_ROW_UNIT * 4
        here = host.local
        self._members, self._rank = tuple(members), here.rank
        self._owners, self._is_owner = tuple(owners), here.rank == owners[0]
        self._memories: list[DeviceMemory] = []
        self._num_writes = 0
        self._host: SharedMemoryGroup | None = here
        here.flags[here.rank, 1] = 0
        try:
            of_job = all_or_none(host, what, lambda: self._make(new_memory))
            ipc_handles = of_job[host.rank - here.rank :][: here.world_size]
            all_or_none(host, what, lambda: self._map(ipc_handles))
        except BaseException:
            self.close()
            raise

    def all_gather(
        self,
        queue: CudaQueue,
        stream: int,
        source: int,
        target: int,
        num_floats: int,
        rows: int,
    ) -> None:
        """Queues a write of [n] float32, and a copy of what all members wrote.

        Rows of `target` [rows, n], at least as many as members, are zero beyond theirs.
        """
        num_bytes = 4 * num_floats
        self._write(queue, stream, source, num_bytes)
        count = len(self._members)
        queue.copy_rows(stream, target, self._slot(0), self._row_bytes, num_bytes, count)
        if rows > count:
            queue.clear(stream, target + count * num_bytes, (rows - count) * num_bytes)

    def broadcast(
        self, queue: CudaQueue, stream: int, source: int, target: int, num_floats: int
    ) -> None:
        """Queues a copy of what the first member has; as `all_gather`, but `target` has [n]."""
        num_bytes = 4 * num_floats
        self._write(queue, stream, source, num_bytes if self._rank == self._members[0] else 0)
        queue.copy(stream, target, self._slot(0), num_bytes)

    def close(self) -> None:
        """Gives the mappings back. Idempotent.

        A block goes with its owner's process, so an owner first waits for all members to be
        through with it; not if an error is what ends it, or `CLOSE_S` are over.
        """
        if self._host is not None:
            fence()
            self._host.flags[self._rank, 1] = 1
            if self._is_owner and sys.exception() is None:
                self._wait_for_members(self._host)
            self._host = None
        for memory in self._memories:
            memory.close()
        self._memories = []

    def _write(self, queue: CudaQueue, stream: int, source: int, num_bytes: int) -> None:
        """Queues a write of this rank's slots, and a wait for all other members' writes.

        For all of them: a rank that writes a slot again must know that all have read the other
        one. So a rank raises its flag also if it has nothing to write.
        """
        self._num_writes += 1
        count = self._num_writes & 0xFFFFFFFF
        own = self._slot(self._members.index(self._rank)) - self._memories[0].address
        for memory in self._memories if num_bytes else ():
            queue.copy(stream, memory.address + own, source, num_bytes)
        queue.raise_flag(stream, self._rank, count)
        for member in self._members:
            if member != self._rank:
                queue.wait_for_flag(stream, member, count)

    def _slot(self, index: int) -> int:
        """Address of the slot in use of the member at `index`, on the own GPU."""
        row = self._num_writes % 2 * len(self._members) + index
        return self._memories[0].address + row * self._row_bytes

    def _wait_for_members(self, host: SharedMemoryGroup) -> None:
        def late() -> list[int]:
            return [member for member in self._members if not host.flags[member, 1]]

        def lost() -> PeerLost | None:
            gone = [member for member in late() if host.is_gone(member)]
            return PeerLost(self._rank, gone[0], "close", 0) if gone else None

        with suppress(PeerLost):
            wait_until(lambda: None if late() else True, lost, CLOSE_S)

    def _make(self, new_memory: NewMemory) -> bytes:
        for _ in self._owners:  # One by one, so that those before one that fails are closed.
            self._memories.append(new_memory())
        size = 2 * len(self._members) * self._row_bytes
        return self._memories[0].create(size) if self._is_owner else b""

    def _map(self, ipc_handles: npt.NDArray[np.uint8]) -> bytes:
        for owner, memory in zip(self._owners, self._memories, strict=True):
            if not (self._is_owner and owner == self._owners[0]):
                memory.open(ipc_handles[owner][:IPC_HANDLE_BYTES].tobytes())
        return b""
