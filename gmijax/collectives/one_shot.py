"""One shot: every GMI writes its gradient into the memory of every GPU, and sums what is there.

Not in the paper, which holds that GMIs cannot share memory of a GPU. CUDA IPC maps memory of the
other GPUs too, over NVLink or PCIe, under a daemon for each GPU and without one. So there is no
ring: one meeting on the host and one program, however many GPUs. What travels is K - t slots to
each GPU, for a ring of K it would be two: it is made for networks whose messages cost more than
their bytes. It is known as a one-shot all-reduce.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from gmijax.collectives.buffers import require_device_buffer, require_mean_input
from gmijax.collectives.device_memory import NewMemory
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import DeviceMean, FloatBuffer
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import leaders

T = TypeVar("T")


class OneShotReducer:
    """A `DeviceReducer` through blocks of device memory, one on each GPU, that all ranks map.

    Args:
      host: this rank's use of the shared block.
      layout: where all GMIs live.
      num_floats: P, length of the buffers for `mean`.
      new_memory: how the processes share a block.

    Raises:
      DeviceMemoryUnavailable, PeerLost, CollectiveTimeout: as `SharedSlots`.
    """

    is_device_resident = True

    def __init__(
        self, host: HostExchange, layout: Layout, num_floats: int, new_memory: NewMemory
    ) -> None:
        self.rank = host.rank
        self.world_size = host.world_size
        self._host = host
        self._num_floats = num_floats
        self._scale = 1.0 / host.world_size
        self.exchange_s = 0.0
        # The own GPU's first, then the following ones: not all write to the same GPU at once.
        owners, near = leaders(layout), layout.gpu_of(host.rank)
        self._slots = SharedSlots(
            host,
            num_floats,
            layout.gmis,
            owners[near:] + owners[:near],
            self._scale,
            new_memory,
            "reduce.strategy=one_shot",
        )

    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """Returns the mean over ranks of `buffer` [P] float32, see `DeviceReducer`.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        require_device_buffer(buffer, self._num_floats)
        _, turns = self._host.begin("mean", self._num_floats)
        with turns.explained():
            buffer.block_until_ready()
        started_s = time.monotonic()
        self._slots.write(buffer, turns)
        mean = self._slots.sum(turns, self._scale)
        turns.end()
        self.exchange_s += time.monotonic() - started_s
        return mean

    def run_on_device(self, program: Callable[[DeviceMean], T]) -> T:
        """See `DeviceReducer`; raises what `mean_on_device` raises.

        The host takes part in every mean: ranks know only from each other that a slot is written.
        """
        self.exchange_s = 0.0
        return jax.block_until_ready(program(self.mean_on_device))

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """The same for a buffer in host memory, with a copy each way; the result is read-only."""
        require_mean_input(buffer, self._num_floats)
        return np.asarray(self.mean_on_device(jax.device_put(buffer)))

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)

    def close(self) -> None:
        """Gives memory back, once no result is in use; calling it twice is fine."""
        self._slots.close()
        self._host.close()
