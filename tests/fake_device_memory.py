"""Device memory for the exchanges without a device: a file without a name.

jax reads it in place, as it reads memory of a GPU: a program sees what is there when it runs.
"""

from __future__ import annotations

import mmap
import os
import struct

import jax
import numpy as np

from gmijax.collectives.device_memory import TICKET_BYTES


class FakeDeviceMemory:
    """A `DeviceMemory` that processes of one user share."""

    def __init__(self) -> None:
        self._mapping: mmap.mmap | None = None

    def create(self, num_bytes: int) -> bytes:
        fd = os.memfd_create("fake-device-memory", os.MFD_CLOEXEC)
        os.ftruncate(fd, num_bytes)
        self._mapping = mmap.mmap(fd, num_bytes)
        return struct.pack("=qqq", os.getpid(), fd, num_bytes).ljust(TICKET_BYTES, b"\xff")

    def open(self, ticket: bytes) -> None:
        pid, fd, num_bytes = struct.unpack_from("=qqq", ticket)
        opened = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDWR)
        self._mapping = mmap.mmap(opened, num_bytes)
        os.close(opened)

    def write(self, offset: int, values: jax.Array) -> None:
        self.start_write(offset, values)
        self.finish_writes()

    def start_write(self, offset: int, values: jax.Array) -> None:
        self._region(offset, values.shape, values.dtype)[...] = np.asarray(values)

    def finish_writes(self) -> None:
        pass

    def view(self, offset: int, shape: tuple[int, ...], dtype=np.float32) -> jax.Array:
        region = self._region(offset, shape, np.dtype(dtype))
        view = jax.dlpack.from_dlpack(region, copy=False)
        assert view.unsafe_buffer_pointer() == region.ctypes.data
        return view

    def close(self) -> None:
        self._mapping = None

    def _region(self, offset: int, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        assert self._mapping is not None
        return np.frombuffer(self._mapping, dtype, int(np.prod(shape)), offset).reshape(shape)


class BrokenDeviceMemory(FakeDeviceMemory):
    """Takes what is written and forgets it: the others see nothing of it."""

    def start_write(self, offset: int, values: jax.Array) -> None:
        del offset, values
