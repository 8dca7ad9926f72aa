"""How the GMIs of one GPU exchange numbers in HAR: one seam, and the way through the host."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from gmijax.collectives.buffers import chunk_bounds
from gmijax.collectives.device_memory import cuda_memory
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.slots import add_slots, read_only
from gmijax.collectives.turns import Turns
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import leaders

if TYPE_CHECKING:
    import jax

B = TypeVar("B", "FloatBuffer", "jax.Array")


class IntraExchange(Protocol[B]):
    """One rank's part in the exchange inside its GPU; all ranks of the job call both, in turn.

    Attributes:
      is_device_resident: whether the buffers are those of jax, in the device's memory.
      all_sum: whether every rank gets the sum of its GPU, not the leader alone.
    """

    is_device_resident: bool
    all_sum: bool

    def sum(self, buffer: B, block: ExchangeBlock, turns: Turns, scale: float) -> B | None:
        """The sum of `buffer` [P] over this GPU's GMIs, times `scale`, for its leader; else None.

        With `all_sum` the others get it too.
        """
        ...

    def spread(self, mean: B | None, block: ExchangeBlock, turns: Turns) -> B:
        """The `mean` [P] that every leader has, for all.

        In host memory it is read-only, and valid until the next call.
        """
        ...

    def close(self) -> None:
        """Releases what the exchange holds; calling it twice is fine."""
        ...


class HostIntra:
    """Through the shared block.

    `sum`: every rank writes its slot; they meet; the GMIs of a GPU sum one chunk of their slots
    each, into the leader's; they meet. `spread`: every leader writes one chunk of the result;
    they meet. A rank writes its slot, and a leader the result, only when all have entered the
    next call and given up the view of the last result.

    Args:
      layout: where all GMIs live.
      rank: this one.
      num_floats: P, length of the buffers.
    """

    is_device_resident = False
    all_sum = False

    def __init__(self, layout: Layout, rank: int, num_floats: int) -> None:
        neighbours, all_leaders = layout.neighbours_of(rank), leaders(layout)
        self._rank = rank
        self._leader = all_leaders[layout.gpu_of(rank)]
        # The leader first: its slot takes the sum.
        self._in_order = (self._leader, *(gmi for gmi in neighbours if gmi != self._leader))
        self._own = _chunk(num_floats, neighbours.index(rank), len(neighbours))
        place = all_leaders.index(self._leader)
        self._written = _chunk(num_floats, place, len(all_leaders))

    def sum(
        self, buffer: FloatBuffer, block: ExchangeBlock, turns: Turns, scale: float
    ) -> FloatBuffer | None:
        """See `IntraExchange`."""
        block.slots[self._rank] = buffer
        turns.meet()
        turns.check_same_call()
        total = block.slots[self._leader]
        # Overflow and NaN are for the caller to judge, not worth a warning here.
        with np.errstate(over="ignore", invalid="ignore"):
            add_slots(block, self._in_order, self._own, total[self._own], scale)
        turns.meet()
        return total if self._rank == self._leader else None

    def spread(self, mean: FloatBuffer | None, block: ExchangeBlock, turns: Turns) -> FloatBuffer:
        """See `IntraExchange`."""
        if mean is not None:
            block.result[self._written] = mean[self._written]
        turns.meet()
        return read_only(block.result)

    def close(self) -> None:
        """Does nothing: the shared block is the reducer's."""


def _chunk(num_floats: int, place: int, num_places: int) -> slice:
    return slice(*chunk_bounds(num_floats, num_places, place))


def _host(layout: Layout, rank: int, num_floats: int, host: HostExchange) -> IntraExchange:
    del host
    return HostIntra(layout, rank, num_floats)


def _ipc(layout: Layout, rank: int, num_floats: int, host: HostExchange) -> IntraExchange:
    from gmijax.collectives.ipc import IpcIntra  # Imports jax.

    return IpcIntra(layout, rank, num_floats, host, cuda_memory)


INTRA: Mapping[str, Callable[[Layout, int, int, HostExchange], IntraExchange]] = {
    "host": _host,
    "ipc": _ipc,
}
"""Every way; where one cannot be had: `why_not_intra` in `gmijax.partition.reduction`."""
