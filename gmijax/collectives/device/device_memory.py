"""Memory of a GPU that several processes map, for modules that need neither jax nor CUDA."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import jax

IPC_HANDLE_BYTES = 64
"""What another process needs to open a block."""


class DeviceMemory(Protocol):
    """A block of memory: `CudaMemory`, or the fake of a test."""

    @property
    def address(self) -> int:
        """Of its first byte on this process's device."""
        ...

    def create(self, num_bytes: int) -> bytes:
        """Makes the block; returns what another process needs to open it."""
        ...

    def open(self, ipc_handle: bytes) -> None:
        """Maps the block that another process has made."""
        ...

    def write(self, offset: int, values: jax.Array) -> None:
        """Copies `values` to `offset` bytes; on return they are there for all processes."""
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
"""How processes share a block."""
