"""MPR, multi-process reduction: the mean through host memory (paper section 4.1)."""

from __future__ import annotations

import numpy as np

from gmijax.collectives.buffers import chunk_bounds
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.slots import add_slots, read_only


class MprReducer:
    """A `Reducer` over shared host memory.

    `mean`: every rank writes its buffer into its own slot; they meet; every rank sums its own
    chunk over all slots, in order of rank and in float32, multiplies by 1/K and writes to the
    shared result; they meet again. Each element is computed once, hence equal on all ranks.

    One slot and one result suffice. A rank writes its slot in the next call only after the
    second meeting, when all have read it. It writes the result only after the first meeting of
    the next `mean`, when all have entered that call and so given up the view of the last one.

    Args:
      host: this rank's use of the shared block.
      num_floats: P, length of the buffers for `mean`.
    """

    is_device_resident = False

    def __init__(self, host: HostExchange, num_floats: int) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._part = slice(*chunk_bounds(num_floats, host.world_size, host.rank))

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over ranks of `buffer` [P] float32, see `Reducer.mean`.

        The result is a read-only view of shared memory, valid until the next call.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        block, turns = self._host.begin_mean(buffer)
        block.slots[self.rank] = buffer
        turns.meet()
        turns.check_same_call()
        self._reduce_chunk(block)
        turns.meet()
        turns.end()
        return read_only(block.result)

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)

    def close(self) -> None:
        """Gives the memory back, once no result is in use; calling it twice is fine."""
        self._host.close()

    def _reduce_chunk(self, block: ExchangeBlock) -> None:
        total = block.result[self._part]
        # Overflow and NaN are for the caller to judge, not worth a warning here.
        with np.errstate(over="ignore", invalid="ignore"):
            add_slots(block, range(self.world_size), self._part, total, 1.0 / self.world_size)
