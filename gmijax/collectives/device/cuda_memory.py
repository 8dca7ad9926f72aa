"""A block of GPU memory that several processes map: CUDA IPC through cuda-bindings."""

from __future__ import annotations

import ctypes
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.collectives.device.cuda_queue import checked, runtime
from gmijax.collectives.device.device_memory import IPC_HANDLE_BYTES
from gmijax.collectives.shared_memory import round_up
from gmijax.errors import CudaError

GRANULE_BYTES = 2 << 20
"""CUDA shares whole granules: a smaller block would show others what else lies in it."""


class CudaMemory:
    """A block of memory of the one GPU that this process sees.

    One process makes the block, others open it, on the same GPU or another of the host. On one
    GPU they must run at the same time under one MPS daemon, or without any.

    Attributes:
      address: of its first byte on this process's device.

    Raises:
      CudaError: from every method.
    """

    def __init__(self) -> None:
        self.address = 0
        self._is_owner = False
        # jax makes the device's primary context as it wants it, and the runtime joins it.
        jax.local_devices()
        checked(runtime.cudaSetDevice(0), "use the GPU")
        flags = runtime.cudaStreamNonBlocking
        self._stream: Any
        (self._stream,) = checked(
            runtime.cudaStreamCreateWithFlags(flags), "make a stream of the GPU"
        )

    def create(self, num_bytes: int) -> bytes:
        """Makes the block; returns what another process needs to open it."""
        size = round_up(num_bytes, GRANULE_BYTES)
        (pointer,) = checked(
            runtime.cudaMalloc(size), f"get {size >> 20} MiB of GPU memory for the exchange"
        )
        self.address, self._is_owner = int(pointer), True
        result = runtime.cudaIpcGetMemHandle(self.address)
        if result[0] != runtime.cudaError_t.cudaSuccess:  # No process has mapped it.
            runtime.cudaFree(self.address)
            self.address = 0
        (handle,) = checked(result, "share GPU memory with other processes")
        return ctypes.string_at(int(handle.getPtr()), IPC_HANDLE_BYTES)

    def open(self, ipc_handle: bytes) -> None:
        """Maps the block that another process has made."""
        handle = runtime.cudaIpcMemHandle_t()
        ctypes.memmove(int(handle.getPtr()), ipc_handle, IPC_HANDLE_BYTES)
        (pointer,) = checked(
            runtime.cudaIpcOpenMemHandle(handle, runtime.cudaIpcMemLazyEnablePeerAccess),
            "map GPU memory of another process",
        )
        self.address = int(pointer)

    def write(self, offset: int, values: jax.Array) -> None:
        """Copies `values` to `offset` bytes; on return they are there for all processes."""
        values.block_until_ready()
        to_device = runtime.cudaMemcpyKind.cudaMemcpyDeviceToDevice
        source, target = values.unsafe_buffer_pointer(), self.address + offset
        checked(
            runtime.cudaMemcpyAsync(target, source, values.nbytes, to_device, self._stream),
            "copy into shared GPU memory",
        )
        checked(runtime.cudaStreamSynchronize(self._stream), "copy into shared GPU memory")

    def view(
        self, offset: int, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32
    ) -> jax.Array:
        """The array at `offset` bytes in place: a program reads what is there when it runs."""
        pointer = self.address + offset
        view = jnp.asarray(_MappedRegion(pointer, shape, np.dtype(dtype)))
        if view.unsafe_buffer_pointer() != pointer:
            raise CudaError("jax copies shared GPU memory where it should read it in place")
        return view

    def close(self) -> None:
        """Gives the mapping back; no view may be in use."""
        if self.address and not self._is_owner:
            # Whatever comes of it: nothing is left to be done with the memory.
            runtime.cudaIpcCloseMemHandle(self.address)
        if self._stream is not None:
            runtime.cudaStreamDestroy(self._stream)
            self._stream = None
        # To free a block that others have mapped is undefined, so the owner's goes with it.
        self.address = 0


class _MappedRegion:
    """Memory as the protocol describes it that jax, CuPy and Numba read arrays by."""

    def __init__(self, pointer: int, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.__cuda_array_interface__ = {
            "version": 3,
            "data": (pointer, False),
            "shape": shape,
            "typestr": dtype.str,
            "strides": None,
            # No stream to wait for: the ranks order what they do by turns.
            "stream": None,
        }
