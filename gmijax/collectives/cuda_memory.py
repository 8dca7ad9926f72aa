"""A block of GPU memory that several processes map: CUDA IPC through cuda-bindings."""

from __future__ import annotations

import ctypes
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.errors import CollectiveError

# By name, because it has no type information, and is not installed everywhere.
runtime: Any = importlib.import_module("cuda.bindings.runtime")

HANDLE_BYTES = 64
GRANULE_BYTES = 2 << 20
"""CUDA shares whole granules: a smaller block would show others what else lies in it."""


class CudaError(CollectiveError):
    """CUDA refused something; the message has its words."""


class CudaMemory:
    """A `DeviceMemory` on the one GPU that this process sees.

    One process makes the block, others open it, on the same GPU or another of the host. On one
    GPU they must run at the same time under one MPS daemon, or without any.

    Raises:
      CudaError: from every method.
    """

    def __init__(self) -> None:
        self._pointer = 0
        self._is_owner = False
        # jax makes the device's primary context as it wants it, and the runtime joins it.
        jax.local_devices()
        _checked(runtime.cudaSetDevice(0), "use the GPU")
        flags = runtime.cudaStreamNonBlocking
        self._stream: Any
        (self._stream,) = _checked(
            runtime.cudaStreamCreateWithFlags(flags), "make a stream of the GPU"
        )

    def create(self, num_bytes: int) -> bytes:
        """See `DeviceMemory`."""
        size = -(-num_bytes // GRANULE_BYTES) * GRANULE_BYTES
        (pointer,) = _checked(
            runtime.cudaMalloc(size), f"get {size >> 20} MiB of GPU memory for the exchange"
        )
        self._pointer, self._is_owner = int(pointer), True
        result = runtime.cudaIpcGetMemHandle(self._pointer)
        if result[0] != runtime.cudaError_t.cudaSuccess:  # Nobody has mapped it.
            runtime.cudaFree(self._pointer)
            self._pointer = 0
        (handle,) = _checked(result, "share GPU memory with other processes")
        return ctypes.string_at(int(handle.getPtr()), HANDLE_BYTES)

    def open(self, ticket: bytes) -> None:
        """See `DeviceMemory`."""
        handle = runtime.cudaIpcMemHandle_t()
        ctypes.memmove(int(handle.getPtr()), ticket, HANDLE_BYTES)
        (pointer,) = _checked(
            runtime.cudaIpcOpenMemHandle(handle, runtime.cudaIpcMemLazyEnablePeerAccess),
            "map GPU memory of another process",
        )
        self._pointer = int(pointer)

    def write(self, offset: int, values: jax.Array) -> None:
        """See `DeviceMemory`."""
        self.start_write(offset, values)
        self.finish_writes()

    def start_write(self, offset: int, values: jax.Array) -> None:
        """See `DeviceMemory`."""
        values.block_until_ready()
        to_device = runtime.cudaMemcpyKind.cudaMemcpyDeviceToDevice
        source, target = values.unsafe_buffer_pointer(), self._pointer + offset
        _checked(
            runtime.cudaMemcpyAsync(target, source, values.nbytes, to_device, self._stream),
            "copy into shared GPU memory",
        )

    def finish_writes(self) -> None:
        """See `DeviceMemory`."""
        _checked(runtime.cudaStreamSynchronize(self._stream), "copy into shared GPU memory")

    def view(
        self, offset: int, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32
    ) -> jax.Array:
        """See `DeviceMemory`."""
        pointer = self._pointer + offset
        view = jnp.asarray(_Region(pointer, shape, np.dtype(dtype)))
        if view.unsafe_buffer_pointer() != pointer:
            raise CudaError("jax copies shared GPU memory where it should read it in place")
        return view

    def close(self) -> None:
        """See `DeviceMemory`."""
        if self._pointer and not self._is_owner:
            # Whatever comes of it: nothing is left to be done with the memory.
            runtime.cudaIpcCloseMemHandle(self._pointer)
        if self._stream is not None:
            runtime.cudaStreamDestroy(self._stream)
            self._stream = None
        # To free a block that others have mapped is undefined, so the owner's goes with it.
        self._pointer = 0


class _Region:
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


def _checked(result: tuple[Any, ...], wish: str) -> tuple[Any, ...]:
    """What a call of the runtime returned, but for its error code."""
    code, *values = result
    if code != runtime.cudaError_t.cudaSuccess:
        said = runtime.cudaGetErrorString(code)[1].decode()
        raise CudaError(f"cannot {wish}: {code.name}: {said}")
    return tuple(values)
