"""HAR, hierarchical reduction: inside every GPU, then a ring between them (section 4.1)."""

from __future__ import annotations

import jax
import numpy as np

from gmijax.collectives.courier import Courier
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.intra import IntraExchange
from gmijax.collectives.mrr import open_rings, run_watched
from gmijax.collectives.ring import Ring, World
from gmijax.collectives.turns import Turns
from gmijax.partition.reduction import leaders


class HarReducer:
    """A `Reducer` that sends one GMI of every GPU, the leader, to a ring.

    `mean`: the GMIs of a GPU give their sum to the leader; the leaders sum over the ring; each
    gives the mean to its GPU.

    Args:
      host: this rank's use of the shared block.
      intra: the exchange inside a GPU.
      world: this process among those of all GMIs; None with one GPU, which needs no ring.
      num_floats: P, length of the buffers for `mean`.
    """

    is_device_resident = False

    def __init__(
        self, host: HostExchange, intra: IntraExchange, world: World | None, num_floats: int
    ) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._intra = intra
        self._ring: Ring | None = None
        self._courier: Courier | None = None
        if world is not None:
            host.rendezvous()
            self._courier = Courier("ring")
            members = leaders(world.layout)
            if self.rank in members:
                self._ring = world.ring(members, num_floats)
            use = self._ring_mean if self._ring is not None else None
            open_rings(world, self._courier, use, num_floats)

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over ranks of `buffer` [P] float32, see `Reducer.mean`.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        block, turns = self._host.begin_mean(buffer)
        total = self._intra.sum(buffer, block, turns)
        mean = None if total is None else self._mean_of_gpus(total, turns)
        result = self._intra.spread(mean, block, turns)
        turns.end()
        return result

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)

    def close(self) -> None:
        """Gives thread and memory back, once no result is in use; calling it twice is fine."""
        if self._courier is not None:
            self._courier.close()
        self._host.close()

    def _mean_of_gpus(self, total: FloatBuffer, turns: Turns) -> FloatBuffer:
        if self._courier is None:
            return total * np.float32(1.0 / self.world_size)
        mean = run_watched(self._courier, turns, lambda: self._ring_mean(jax.device_put(total)))
        return np.asarray(mean)

    def _ring_mean(self, total: jax.Array) -> jax.Array:
        assert self._ring is not None
        return self._ring.sum(total, 1.0 / self.world_size)
