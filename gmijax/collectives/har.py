"""HAR, hierarchical reduction: host memory inside a GPU, a ring between GPUs (section 4.1)."""

from __future__ import annotations

import jax
import numpy as np

from gmijax.collectives.buffers import chunk_bounds
from gmijax.collectives.courier import Courier
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.mpr import add_slots, read_only
from gmijax.collectives.mrr import open_rings, run_watched
from gmijax.collectives.ring import Ring, World
from gmijax.collectives.turns import Turns
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import leaders


class HarReducer:
    """A `Reducer` that sends one GMI of every GPU, the leader, to a ring.

    `mean`: every rank writes its slot of the shared block; they meet; the GMIs of a GPU sum one
    chunk of their slots each, into the leader's; they meet; the leaders sum over the ring; each
    writes a chunk of the result; they meet again. A rank writes its slot, and a leader the
    result, only when all have entered the next call and given up the view of the last result.

    Args:
      host: this rank's use of the shared block.
      layout: where all GMIs live; any.
      world: this process among those of all GMIs; None with one GPU, which needs no ring.
      num_floats: P, length of the buffers for `mean`.
    """

    is_device_resident = False

    def __init__(
        self, host: HostExchange, layout: Layout, world: World | None, num_floats: int
    ) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._neighbours = layout.neighbours_of(self.rank)
        self._leaders = leaders(layout)
        self._leader = self._leaders[layout.gpu_of(self.rank)]
        self._part = _chunk(num_floats, self._neighbours.index(self.rank), len(self._neighbours))
        self._ring: Ring | None = None
        self._courier: Courier | None = None
        if world is not None:
            self._courier = Courier("ring")
            if self.rank == self._leader:
                self._ring = world.ring(self._leaders, num_floats)
            host.rendezvous()
            use = self._ring_mean if self._ring is not None else None
            open_rings(world, self._courier, use, num_floats)

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
        self._sum_on_gpu(block)
        turns.meet()
        if self.rank == self._leader:
            self._mean_of_gpus(block, turns)
        turns.meet()
        turns.end()
        return read_only(block.result)

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)

    def close(self) -> None:
        """Gives thread and memory back, once no result is in use; calling it twice is fine."""
        if self._courier is not None:
            self._courier.close()
        self._host.close()

    def _sum_on_gpu(self, block: ExchangeBlock) -> None:
        others = [gmi for gmi in self._neighbours if gmi != self._leader]
        # The leader first: its slot takes the sum.
        with np.errstate(over="ignore", invalid="ignore"):
            add_slots(
                block, (self._leader, *others), self._part, block.slots[self._leader, self._part]
            )

    def _mean_of_gpus(self, block: ExchangeBlock, turns: Turns) -> None:
        total = block.slots[self._leader]
        if self._ring is None or self._courier is None:
            np.multiply(total, np.float32(1.0 / self.world_size), out=block.result)
            return
        mean = run_watched(self._courier, turns, lambda: self._ring_mean(jax.device_put(total)))
        place = self._leaders.index(self.rank)
        part = _chunk(total.size, place, len(self._leaders))
        block.result[part] = np.asarray(mean)[part]

    def _ring_mean(self, total: jax.Array) -> jax.Array:
        assert self._ring is not None
        return self._ring.sum(total, 1.0 / self.world_size)


def _chunk(num_floats: int, place: int, num_places: int) -> slice:
    return slice(*chunk_bounds(num_floats, num_places, place))
