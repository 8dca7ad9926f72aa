"""MRR and flat: the mean over rings of GPUs, without leaving them (paper section 4.1).

MRR has one ring for every place on a GPU: the k-th GMIs of all GPUs. They sum at the same time;
then one GMI of each ring, each on another GPU, sums the partial results in a last ring; then each
of these gives the total to the members of its first ring. With one GMI on each GPU there is one
ring, and nothing more to do: that is `flat`, plain data parallelism.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from gmijax.collectives.buffers import require_device_buffer
from gmijax.collectives.courier import Courier
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import DeviceMean, Step, TracedStep
from gmijax.collectives.on_device import OnDevice
from gmijax.collectives.ring import World
from gmijax.collectives.spmd import SpmdStep
from gmijax.collectives.together import Together, WatchedStep
from gmijax.partition.reduction import is_one_per_gpu

T = TypeVar("T")


class RingReducer(OnDevice):
    """A `DeviceReducer` over rings of GPUs; the layout must be even.

    `mean` first meets all ranks on the host: that finds peers that are missing, and calls that
    do not match, before anybody is caught in a library's collective. The shared block also
    carries `all_gather`.

    Args:
      host: this rank's use of the shared block.
      world: this process among those of all GMIs.
      num_floats: P, length of the buffers for `mean`.
    """

    exchange_s = None

    def __init__(self, host: HostExchange, world: World, num_floats: int) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._num_floats = num_floats
        self._world = world
        self._rings = RingMean(world, num_floats)
        self._courier = Courier("ring")
        self._together = Together(host, self._courier, num_floats)
        host.rendezvous()
        open_rings(world, self._courier, self._rings, num_floats)

    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """See `OnDevice.mean_on_device`."""
        require_device_buffer(buffer, self._num_floats)
        return self.run_on_device(lambda mean: mean(buffer))

    def run_on_device(self, program: Callable[[DeviceMean], T]) -> T:
        """See `DeviceReducer`; raises what `mean_on_device` raises."""
        return self._together.mean(lambda: jax.block_until_ready(program(self._mean)))

    def spmd(self, step: Step) -> TracedStep | None:
        """See `DeviceReducer`; with one GMI on each GPU, since a program has each GPU once."""
        layout = self._world.layout
        if not is_one_per_gpu(layout):
            return None
        ranks = [gmi for gmis in layout.gmis_of_gpu for gmi in gmis]
        return WatchedStep(SpmdStep(self._world.mesh(ranks), ranks, step), self._together)

    def close(self) -> None:
        """Gives thread and memory back; calling it twice is fine."""
        self._courier.close()
        self._host.close()

    def _mean(self, buffer: jax.Array) -> jax.Array:
        require_device_buffer(buffer, self._num_floats)
        return self._rings(buffer)


class RingMean:
    """The programs of one rank: its first ring, perhaps the last one, and the way back.

    Args:
      world: this process among those of all GMIs.
      num_floats: P, length of the buffers.
    """

    def __init__(self, world: World, num_floats: int) -> None:
        gmis_of_gpu, rank = world.layout.gmis_of_gpu, world.rank
        self._scale = 1.0 / world.layout.num_gmis
        self._place = world.layout.neighbours_of(rank).index(rank)
        self._num_rings = len(gmis_of_gpu[0])
        self._first = world.ring([gmis[self._place] for gmis in gmis_of_gpu], num_floats)
        # The ring of place k ends on GPU k: the endpoints are on different GPUs, as NCCL asks.
        endpoints = [gmis_of_gpu[place][place] for place in range(self._num_rings)]
        self._last = (
            world.ring(endpoints, num_floats)
            if self._num_rings > 1 and rank in endpoints
            else None
        )

    def __call__(self, buffer: jax.Array) -> jax.Array:
        """The mean over all GMIs of `buffer` [P]; every rank must call it."""
        if self._num_rings == 1:
            return self._first.sum(buffer, self._scale)
        total = self._first.sum(buffer)
        if self._last is not None:
            total = self._last.sum(total, self._scale)
        return self._first.broadcast(total, source=self._place)


def open_rings(
    world: World,
    courier: Courier,
    mean: Callable[[jax.Array], jax.Array] | None,
    num_floats: int,
) -> None:
    """Uses all rings once, which connects and compiles them, and leaves the coordination."""

    def first_use() -> None:
        if mean is not None:
            mean(jax.device_put(np.zeros(num_floats, np.float32))).block_until_ready()
        if not world.is_kept:
            world.leave()

    # Without a limit: the controller ends a GMI that does not get through its start.
    courier.run(first_use, lambda done: done.wait())
