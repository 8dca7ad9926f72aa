"""MPR, multi-process reduction: the mean through host memory (paper section 4.1)."""

from __future__ import annotations

import numpy as np

from gmijax.collectives.buffers import chunk_bounds, require_gather_input, require_mean_input
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock, attach
from gmijax.collectives.turns import Turns
from gmijax.errors import CollectiveError

BLOCK_FLOATS = 32768
"""Floats reduced at a time: 128 KiB of sums stay in the second-level cache over all ranks."""


class MprReducer:
    """A `Reducer` over shared host memory.

    `mean`: every rank writes its buffer into its own slot; they meet; every rank sums its own
    chunk over all slots, in order of rank and in float32, multiplies by 1/K and writes to the
    shared result; they meet again. Each element is computed once, hence equal on all ranks.

    One slot and one result suffice. A rank writes its slot in the next call only after the
    second meeting, when all have read it. It writes the result only after the first meeting of
    the next `mean`, when all have entered that call and so given up the view of the last one.
    `all_gather` has one meeting and hence two regions in turn: a rank that writes one of them
    again has passed the call in between, which all entered after reading.

    Args:
      fd: descriptor of the shared block; the caller may close it afterwards.
      rank: 0 to `world_size - 1`.
      world_size: K, number of ranks.
      num_floats: P, length of the buffers for `mean`.
      timeout_s: longest wait for other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.

    Raises:
      ConfigError: numbers that make no sense.
      CollectiveError: no memory, not such a descriptor, or the rank is taken.
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
    ) -> None:
        self.rank = rank
        self.world_size = world_size
        self._block: ExchangeBlock | None = attach(fd, rank, world_size, num_floats)
        self._turns = Turns(self._block, timeout_s, rendezvous_timeout_s)
        self._bounds = chunk_bounds(num_floats, world_size, rank)

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over ranks of `buffer` [P] float32, see `Reducer.mean`.

        The result is a read-only view of shared memory, valid until the next call.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        block = self._open_block("mean")
        require_mean_input(buffer, block.result.size)
        self._turns.begin("mean", buffer.size)
        block.slots[self.rank] = buffer
        self._turns.meet()
        self._turns.check_same_call()
        self._reduce_chunk(block)
        self._turns.meet()
        self._turns.end()
        result = block.result.view()
        result.flags.writeable = False
        return result

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, see `Reducer.all_gather`.

        The result is the caller's own.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed; M is limited
            to `MAX_GATHER_FLOATS`.
        """
        block = self._open_block("all_gather")
        require_gather_input(values)
        self._turns.begin("all_gather", values.size)
        region = block.gathered[self._turns.step % 2]
        region[self.rank, : values.size] = values
        self._turns.meet()
        self._turns.check_same_call()
        gathered = region[:, : values.size].copy()
        self._turns.end()
        return gathered

    def close(self) -> None:
        """Gives the memory back, once no result is in use; calling it twice is fine."""
        if self._block is not None:
            self._turns.leave()
            del self._turns
            self._block = None

    def _open_block(self, operation: str) -> ExchangeBlock:
        if self._block is None:
            raise CollectiveError(f"rank {self.rank}: {operation} after close")
        return self._block

    def _reduce_chunk(self, block: ExchangeBlock) -> None:
        scale = np.float32(1.0 / self.world_size)
        low, high = self._bounds
        # Overflow and NaN are for the caller to judge, not worth a warning here.
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(low, high, BLOCK_FLOATS):
                part = slice(start, min(start + BLOCK_FLOATS, high))
                total = block.result[part]
                total[:] = block.slots[0, part]
                for rank in range(1, self.world_size):
                    total += block.slots[rank, part]
                total *= scale
