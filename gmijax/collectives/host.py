"""What every strategy does through the shared block: gather, meet, leave."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gmijax.collectives.buffers import require_gather_input, require_mean_input
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock, attach, process_of
from gmijax.collectives.turns import Turns
from gmijax.errors import CollectiveError


class HostExchange:
    """One rank's use of the shared block, from `attach` to `close`.

    Args:
      fd: descriptor of the shared block; the caller may close it afterwards.
      rank: 0 to `world_size - 1`.
      world_size: K, number of ranks.
      num_floats: P, length of the buffers for `mean`.
      timeout_s: longest wait for other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.

    Attributes:
      rank: this rank.
      world_size: K.

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

    def rendezvous(self) -> None:
        """Waits until all ranks have attached; raises as `Turns.rendezvous` does."""
        self._turns.rendezvous()

    def begin(self, operation: str, buffer_floats: int) -> tuple[ExchangeBlock, Turns]:
        """Opens a call; the caller ends it with `Turns.end`.

        Raises:
          CollectiveError: after `close`, or see `Turns.begin`.
          PeerLost, CollectiveTimeout: see `Turns.begin`.
        """
        block = self._open_block(operation)
        self._turns.begin(operation, buffer_floats)
        return block, self._turns

    def begin_mean(self, buffer: FloatBuffer) -> tuple[ExchangeBlock, Turns]:
        """Opens a call of `mean` with a buffer [P] float32; raises as `begin` does."""
        require_mean_input(buffer, self._open_block("mean").result.size)
        return self.begin("mean", buffer.size)

    @property
    def flags(self) -> npt.NDArray[np.uint32]:
        """See `ExchangeBlock`."""
        return self._open_block("flags").flags

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, see `Reducer.all_gather`.

        One meeting and hence two regions in turn: a rank that writes one of them again has
        passed the call in between, which all entered after reading. The result is the caller's.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed; M is limited
            to `MAX_GATHER_FLOATS`.
        """
        self._open_block("all_gather")
        require_gather_input(values)
        block, turns = self.begin("all_gather", values.size)
        region = block.gathered[turns.step % 2]
        region[self.rank, : values.size] = values
        turns.meet()
        turns.check_same_call()
        gathered = region[:, : values.size].copy()
        turns.end()
        return gathered

    def introduce(self, values: FloatBuffer) -> FloatBuffer:
        """`all_gather` as part of the start: others may still compile in the call after it."""
        gathered = self.all_gather(values)
        self._turns.restart()
        return gathered

    def is_gone(self, peer: int) -> bool:
        """Whether an attached peer has closed its exchange, or its process has ended."""
        return not process_of(self._open_block("is_gone"), peer).is_running()

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
