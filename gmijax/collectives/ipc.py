"""HAR's exchange inside a GPU without leaving it: memory of the GPU that all its GMIs map."""

from __future__ import annotations

import jax

from gmijax.collectives.device_memory import NewMemory
from gmijax.collectives.host import HostExchange
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.collectives.turns import Turns
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import is_even, leaders


class IpcIntra:
    """Through a block of device memory that the leader makes, with slots for the GPU's GMIs.

    With one GPU, or as many GMIs on all, every rank writes its slot, they meet, and every rank
    sums all slots of its GPU, in the same order.

    With other layouts the leaders alone sum. `spread`: they write the mean into the result; all
    meet; the others copy it. It is written again after the next call's first meeting, before
    which all had finished copying.

    Attributes:
      slots: of all GMIs of the GPU.

    Args:
      layout: where all GMIs live.
      rank: this one.
      num_floats: P, length of the buffers.
      host: this rank's use of the shared block, to hand the block around.
      new_memory: how the processes share the block.

    Raises:
      DeviceMemoryUnavailable, PeerLost, CollectiveTimeout: as `SharedSlots`.
    """

    is_device_resident = True

    def __init__(
        self,
        layout: Layout,
        rank: int,
        num_floats: int,
        host: HostExchange,
        new_memory: NewMemory,
    ) -> None:
        neighbours = layout.neighbours_of(rank)
        leader = leaders(layout)[layout.gpu_of(rank)]
        self.all_sum = is_even(layout)
        self._sums = self.all_sum or rank == leader
        scale = 1.0 if layout.num_gpus > 1 else 1.0 / len(neighbours)
        self.slots = SharedSlots(
            host, num_floats, neighbours, [leader], scale, new_memory, "reduce.intra=ipc"
        )

    def sum(
        self, buffer: jax.Array, block: ExchangeBlock, turns: Turns, scale: float
    ) -> jax.Array | None:
        """See `IntraExchange`; with an even layout every rank gets the sum."""
        del block
        self.slots.write(buffer, turns)
        return self.slots.sum(turns, scale) if self._sums else None

    def spread(self, mean: jax.Array | None, block: ExchangeBlock, turns: Turns) -> jax.Array:
        """See `IntraExchange`; the result may still be computed, and is the caller's own."""
        del block
        if self.all_sum and mean is not None:
            return mean
        if mean is not None:
            self.slots.write_result(mean, turns)
        turns.meet()
        return mean if mean is not None else self.slots.read_result(turns)

    def close(self) -> None:
        """Gives the mapping back; calling it twice is fine."""
        self.slots.close()
