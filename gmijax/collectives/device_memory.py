"""Memory of a GPU that several processes map: what the exchanges need of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.errors import CollectiveError

if TYPE_CHECKING:
    import jax

TICKET_BYTES = 64
"""Room for what another process needs to open a block."""


class DeviceMemoryUnavailable(CollectiveError):
    """It cannot be had here; raised on all ranks of the job alike."""


class DeviceMemory(Protocol):
    """A block of device memory that processes share; `CudaMemory` is the real one."""

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
    from gmijax.collectives.cuda_memory import CudaMemory

    return CudaMemory()
