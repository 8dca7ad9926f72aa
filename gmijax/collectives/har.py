"""HAR, hierarchical reduction: inside every GPU, then a ring between them (section 4.1)."""

from __future__ import annotations

from typing import Generic

import jax
import numpy as np

from gmijax.collectives.courier import Courier
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.intra import B, IntraExchange
from gmijax.collectives.ipc import IpcIntra
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.mrr import open_rings
from gmijax.collectives.on_device import HostPaced
from gmijax.collectives.ring import Ring, World
from gmijax.collectives.together import run_watched
from gmijax.collectives.turns import Turns
from gmijax.partition.reduction import leaders


class _Hierarchy(Generic[B]):
    """What both forms of HAR have in common; B is how they hold a buffer.

    Attributes:
      is_device_resident: see `Reducer`.

    Args:
      host: this rank's use of the shared block.
      intra: the exchange inside a GPU.
      world: this process among those of all GMIs; None with one GPU, which needs no ring.
      num_floats: P, length of the buffers for `mean`.
    """

    is_device_resident: bool

    def __init__(
        self, host: HostExchange, intra: IntraExchange[B], world: World | None, num_floats: int
    ) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._intra = intra
        self._num_floats = num_floats
        self._ring: LeaderRing | None = None
        if world is not None:
            self._ring = LeaderRing(host, world, num_floats, of_all=intra.all_sum)

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)

    def close(self) -> None:
        """Gives thread and memory back, once no result is in use; calling it twice is fine."""
        if self._ring is not None:
            self._ring.close()
        if self._is_through():
            self._intra.close()
        self._host.close()

    def _is_through(self) -> bool:
        """Whether the device is through with what `intra` holds."""
        return self._ring is None or not self._ring.is_stuck


class HarReducer(_Hierarchy[FloatBuffer]):
    """A `Reducer` that sends one GMI of every GPU, the leader, to a ring.

    `mean`: the GMIs of a GPU give their sum to the leader; the leaders sum over the ring; each
    gives the mean to its GPU.
    """

    is_device_resident = False

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over ranks of `buffer` [P] float32, see `Reducer.mean`.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        block, turns = self._host.begin_mean(buffer)
        scale = 1.0 if self._ring else 1.0 / self.world_size
        mean = self._intra.sum(buffer, block, turns, scale)
        if mean is not None and self._ring is not None:
            mean = np.asarray(self._ring.mean(jax.device_put(mean), turns))
        result = self._intra.spread(mean, block, turns)
        turns.end()
        return result


class DeviceHarReducer(_Hierarchy[jax.Array], HostPaced):
    """The same without leaving the GPUs: a `DeviceReducer`.

    Where all GPUs have as many GMIs, every GMI is a leader: it sums over its GPU by itself, and
    the k-th GMIs of all GPUs have a ring. Then nobody waits for a leader's answer.
    """

    def __init__(
        self, host: HostExchange, intra: IpcIntra, world: World | None, num_floats: int
    ) -> None:
        super().__init__(host, intra, world, num_floats)
        if world is None:
            self._all_slots = intra.slots

    def _is_through(self) -> bool:
        return super()._is_through() and self._leave_stream()

    def _exchange(self, buffer: jax.Array, block: ExchangeBlock, turns: Turns) -> jax.Array:
        scale = 1.0 if self._ring else 1.0 / self.world_size
        mean = self._intra.sum(buffer, block, turns, scale)
        if mean is not None and self._ring is not None:
            mean = self._ring.mean(mean, turns)
        result = self._intra.spread(mean, block, turns)
        if self._ring is not None and self._ring.is_of_all:
            turns.arrive()  # Where others look for this rank while their rings run.
        return result


class LeaderRing:
    """The ring over one GMI of every GPU; all ranks of the job make one, leaders use it.

    Args:
      host: this rank's use of the shared block.
      world: this process among those of all GMIs.
      num_floats: P, length of the buffers.
      of_all: all GMIs lead, and the k-th of all GPUs have a ring; the layout must be even.

    Attributes:
      is_of_all: the same.
    """

    def __init__(self, host: HostExchange, world: World, num_floats: int, *, of_all: bool) -> None:
        host.rendezvous()
        self.is_of_all = of_all
        self._scale = 1.0 / host.world_size
        self._courier = Courier("ring")
        members = leaders(world.layout)
        if of_all:
            place = world.layout.neighbours_of(host.rank).index(host.rank)
            members = tuple(gmis[place] for gmis in world.layout.gmis_of_gpu)
        self._ring: Ring | None = None
        if host.rank in members:
            self._ring = world.ring(members, num_floats)
        use = self._mean if self._ring is not None else None
        open_rings(world, self._courier, use, num_floats)

    def mean(self, total: jax.Array, turns: Turns) -> jax.Array:
        """The mean over all GMIs, from the `total` [P] of every GPU; raises as `run_watched`."""
        return run_watched(self._courier, turns, lambda: jax.block_until_ready(self._mean(total)))

    @property
    def is_stuck(self) -> bool:
        """See `Courier`."""
        return self._courier.is_stuck

    def close(self) -> None:
        """Ends the thread; calling it twice is fine."""
        self._courier.close()

    def _mean(self, total: jax.Array) -> jax.Array:
        assert self._ring is not None
        if self.is_of_all:
            return self._ring.ordered_sum(total, self._scale)
        return self._ring.sum(total, self._scale)
