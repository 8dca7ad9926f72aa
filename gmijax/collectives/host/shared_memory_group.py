"""All-gather, all-reduce and broadcast between the ranks of one host, through its shared block."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gmijax.collectives.host.barrier import Barrier
from gmijax.collectives.host.shared_block import (
    FLOATS_PER_LINE,
    MAX_GATHER_FLOATS,
    SharedBlock,
    attach,
)
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.shared_memory import process_of
from gmijax.collectives.strategies import Groups
from gmijax.errors import CollectiveError

PIECE_FLOATS = 32768
"""Floats summed at a time: 128 KiB of sums stay in the second-level cache over all ranks."""


class SharedMemoryGroup:
    """One rank's use of the shared block, from `attach` to `close`.

    All calls are collective: every rank of the job makes the same ones in the same order, also
    those that are in none of the groups. Results are bit-identical on the members of a group.

    A rank uses its two slots in turn. It writes one again in the call after the next one; by then
    all others have passed a barrier in between, after reading what this call left.

    Args:
      fd: descriptor of the shared block; the caller may close it afterwards.
      rank: 0 to `world_size - 1`.
      world_size: K, number of ranks.
      num_floats: P, length of the largest buffer.
      timeout_s: longest wait for other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.
      lane: of the block; each thread that makes calls takes a lane of its own.
      ids: see `SharedBlock`; None: those of the GMIs are their ranks.

    Raises:
      CollectiveError: no memory, not such a descriptor, or the rank is taken; and, from every
        call: ranks make different calls, an earlier one failed, or after `close`.
      PeerLost, CollectiveTimeout: (from every call) a rank is gone, or did not arrive in time.
    """

    def __init__(
        self,
        fd: int,
        rank: int,
        world_size: int,
        num_floats: int,
        *,
        timeout_s: float,
        rendezvous_timeout_s: float,
        lane: int = 0,
        ids: Sequence[int] | None = None,
    ) -> None:
        self.rank = rank
        self.world_size = world_size
        block = attach(fd, rank, world_size, num_floats, lane, ids)
        self.ids = block.ids
        self._block: SharedBlock | None = block
        self.barrier = Barrier(block, timeout_s, rendezvous_timeout_s)

    def all_reduce(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """Writes the sum over the rank's group of `source` [n] into `target` [n], n <= P.

        Every member sums a part of it in the order of the group, so each number is computed once.
        For a rank in no group the target gets the source, which may be the target. For
        `call_index` see `Barrier.begin`.
        """
        slots, group = self._shared("sum", source, groups, call_index)
        if group:
            part = chunk(source.size, group.index(self.rank), len(group))
            # In place: no other rank reads this part of the first member's slot.
            _add(slots, group, part)
        self.barrier.wait()
        target[:] = slots[group[0] if group else self.rank]
        self.barrier.end()

    def broadcast(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """Writes what the first of the rank's group has as `source` [n] into `target` [n]."""
        slots, group = self._shared("broadcast", source, groups, call_index)
        target[:] = slots[group[0] if group else self.rank]
        self.barrier.end()

    def all_gather_into(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """Writes what all of the rank's group have as `source` [n] into `target` [m, n]."""
        slots, group = self._shared("gather", source, groups, call_index)
        for row, member in zip(target, group or (self.rank,), strict=False):
            row[:] = slots[member]
        self.barrier.end()

    def all_gather(self, values: FloatBuffer, *, while_unresponsive: bool = False) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, M <= `MAX_GATHER_FLOATS`.

        For `while_unresponsive` see `Barrier.wait`.
        """
        if values.dtype != np.float32 or values.ndim != 1 or values.size > MAX_GATHER_FLOATS:
            raise CollectiveError(
                f"all_gather of {values.dtype} {list(values.shape)}: expected a vector of at "
                f"most {MAX_GATHER_FLOATS} float32"
            )
        block = self._open_block("all_gather")
        self.barrier.begin("all_gather", values.size)
        region = block.gathered[self.barrier.step % 2]
        region[self.rank, : values.size] = values
        self._synchronize(while_unresponsive=while_unresponsive)
        gathered = region[:, : values.size].copy()
        self.barrier.end()
        return gathered

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over all ranks of `buffer` [P] float32: the sum times 1 / K."""
        total = np.empty_like(buffer)
        self.all_reduce(buffer, total, (tuple(range(self.world_size)),))
        total *= np.float32(1.0 / self.world_size)
        return total

    def bootstrap_all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """`all_gather` as part of the start: others may still compile in the call after it."""
        gathered = self.all_gather(values)
        self.barrier.restart()
        return gathered

    @property
    def flags(self) -> npt.NDArray[np.uint32]:
        """See `SharedBlock`."""
        return self._open_block("flags").flags

    @property
    def local(self) -> SharedMemoryGroup:
        """This one: all ranks are of its host. See `MultiNodeGroup`."""
        return self

    def of_node(self, groups: Groups) -> Groups:
        """The groups: all ranks are of this host. See `MultiNodeGroup`."""
        return groups

    def is_gone(self, peer: int) -> bool:
        """Whether an attached peer has closed its exchange, or its process has ended."""
        return not process_of(self._open_block("is_gone").lines[peer]).is_running()

    def heartbeat(self) -> None:
        """Signals the others that this rank waits for a rank outside this block."""
        self._open_block("heartbeat").lines["heartbeats"][self.rank] += 1

    def close(self) -> None:
        """Gives the memory back. Idempotent."""
        if self._block is not None:
            self.barrier.leave()
            self._block = None

    def _shared(
        self, operation: str, source: FloatBuffer, groups: Groups, call_index: int
    ) -> tuple[FloatBuffer, Sequence[int]]:
        """Opens a call; what all ranks have as `source` [K, n], and the members of the group."""
        block = self._open_block(operation)
        self.barrier.begin(operation, source.size, call_index)
        slots = block.slots[self.barrier.step % 2, :, : source.size]
        slots[self.rank] = source
        self._synchronize()
        return slots, _group_of(self.rank, groups)

    def _synchronize(self, *, while_unresponsive: bool = False) -> None:
        self.barrier.wait(while_unresponsive=while_unresponsive)
        self.barrier.check_same_call()

    def _open_block(self, operation: str) -> SharedBlock:
        if self._block is None:
            raise CollectiveError(f"GMI {self.ids[self.rank]}: {operation} after close")
        return self._block


def chunk(num_floats: int, index: int, num_members: int) -> slice:
    """The part of a buffer [P] that the member at `index` reduces.

    The chunks of all members are disjoint, in order, and cover the buffer. They begin at whole
    cache lines, so that no two ranks write to one line; trailing chunks may be empty.
    """
    num_lines = -(-num_floats // FLOATS_PER_LINE)
    low, high = (num_lines * p // num_members * FLOATS_PER_LINE for p in (index, index + 1))
    return slice(min(low, num_floats), min(high, num_floats))


def _add(slots: FloatBuffer, members: Sequence[int], part: slice) -> None:
    """Adds what the other members have within `part` to the first one's."""
    # Overflow and NaN are for the caller to judge, not worth a warning here.
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(part.start, part.stop, PIECE_FLOATS):
            end = min(start + PIECE_FLOATS, part.stop)
            total = slots[members[0], start:end]
            for member in members[1:]:
                total += slots[member, start:end]


def _group_of(rank: int, groups: Groups) -> Sequence[int]:
    return next((group for group in groups if rank in group), ())
