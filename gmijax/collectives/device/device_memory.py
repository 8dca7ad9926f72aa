"""Memory of a GPU that several processes map: what the exchanges need of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import jax

TICKET_BYTES = 64
"""Room for what another process needs to open a block."""


class DeviceQueue(Protocol):
    """Work for a stream of the device, which does it in order; all addresses are the device's."""

    def copy(self, stream: int, target: int, source: int, num_bytes: int) -> None:
        """Copies bytes."""
        ...

    def copy_rows(
        self, stream: int, target: int, source: int, pitch: int, num_bytes: int, rows: int
    ) -> None:
        """Copies `num_bytes` of each row to the next ones in `target`; rows are `pitch` apart."""
        ...

    def clear(self, stream: int, target: int, num_bytes: int) -> None:
        """Sets bytes to zero."""
        ...

    def raise_flag(self, stream: int, rank: int, count: int) -> None:
        """Sets a flag when all before it is done, and seen by who sees the flag."""
        ...

    def wait_for_flag(self, stream: int, rank: int, count: int) -> None:
        """Holds the stream until a flag has come to `count`."""
        ...

    def start_clock(self, stream: int) -> None:
        """From here on the stream's time counts, until `stop_clock`."""
        ...

    def stop_clock(self, stream: int) -> None:
        """See `start_clock`."""
        ...

    def clocked_s(self) -> float:
        """Seconds that counted and have not been told before; of clocks that have stopped."""
        ...

    def close(self) -> None:
        """Gives the flags back; calling it twice is fine."""
        ...


class DeviceMemory(Protocol):
    """A block of device memory that processes share; `CudaMemory` is the real one.

    Attributes:
      address: of its first byte on this process's device.
    """

    address: int

    def create(self, num_bytes: int) -> bytes:
        """Makes the block; returns what another process needs to open it."""
        ...

    def open(self, ticket: bytes) -> None:
        """Maps the block that another process has made."""
        ...

    def write(self, offset: int, values: jax.Array) -> None:
        """Copies `values` to `offset` bytes; on return they are there for all processes."""
        ...

    def start_write(self, offset: int, values: jax.Array) -> None:
        """Begins a copy of `values` to `offset` bytes; they stay as they are until it is done."""
        ...

    def finish_writes(self) -> None:
        """Waits until what was begun is there for all processes."""
        ...

    def view(
        self, offset: int, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32
    ) -> jax.Array:
        """The array at `offset` bytes in place: a program reads what is there when it runs."""
        ...

    def close(self) -> None:
        """Gives the mapping back; no view may be in use."""
        ...


NewMemory: TypeAlias = Callable[[], DeviceMemory]
"""How processes share a block: `cuda_memory`, or what a test puts in its place."""


def cuda_memory() -> DeviceMemory:
    """A block on the GPU that this process sees; needs cuda-bindings, and imports jax."""
    from gmijax.collectives.device.cuda_memory import CudaMemory

    return CudaMemory()
