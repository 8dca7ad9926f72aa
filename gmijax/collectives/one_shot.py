"""One shot: every GMI writes its gradient into the memory of every GPU, and sums what is there.

Not in the paper, which holds that GMIs cannot share memory of a GPU. CUDA IPC maps memory of the
other GPUs too, over NVLink or PCIe, under a daemon for each GPU and without one. So there is no
ring: one meeting on the host and one program, however many GPUs. What travels is K - t slots to
each GPU, for a ring of K it would be two: it is made for networks whose messages cost more than
their bytes. It is known as a one-shot all-reduce.
"""

from __future__ import annotations

import jax

from gmijax.collectives.device_memory import NewMemory
from gmijax.collectives.host import HostExchange
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.on_device import HostPaced
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.collectives.turns import Turns
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import leaders


class OneShotReducer(HostPaced):
    """A `DeviceReducer` through blocks of device memory, one on each GPU, that all ranks map.

    Args:
      host: this rank's use of the shared block.
      layout: where all GMIs live.
      num_floats: P, length of the buffers for `mean`.
      new_memory: how the processes share a block.

    Raises:
      DeviceMemoryUnavailable, PeerLost, CollectiveTimeout: as `SharedSlots`.
    """

    def __init__(
        self, host: HostExchange, layout: Layout, num_floats: int, new_memory: NewMemory
    ) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._num_floats = num_floats
        self._scale = 1.0 / host.world_size
        # The own GPU's first, then the following ones: not all write to the same GPU at once.
        owners, near = leaders(layout), layout.gpu_of(host.rank)
        self._all_slots = self._slots = SharedSlots(
            host,
            num_floats,
            layout.gmis,
            owners[near:] + owners[:near],
            self._scale,
            new_memory,
            "reduce.strategy=one_shot",
        )

    def close(self) -> None:
        """Gives memory back, once no result is in use; calling it twice is fine."""
        if self._leave_stream():
            self._slots.close()
        self._host.close()

    def _exchange(self, buffer: jax.Array, block: ExchangeBlock, turns: Turns) -> jax.Array:
        del block
        self._slots.write(buffer, turns)
        return self._slots.sum(turns, self._scale)
