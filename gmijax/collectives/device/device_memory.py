"""Memory of a GPU that several processes map, for those who need neither jax nor CUDA."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from gmijax.collectives.device.cuda_memory import CudaMemory

TICKET_BYTES = 64
"""What another process needs to open a block."""

NewMemory: TypeAlias = "Callable[[], CudaMemory]"
"""How processes share a block: `cuda_memory`, or what a test puts in its place."""


def cuda_memory() -> CudaMemory:
    """A block on the GPU that this process sees; needs cuda-bindings, and imports jax."""
    from gmijax.collectives.device.cuda_memory import CudaMemory

    return CudaMemory()
