"""Device memory for the exchanges without a device: a file without a name.

jax reads it in place, as it reads memory of a GPU: a program sees what is there when it runs.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import struct
import time

import jax
import numpy as np

from gmijax.collectives.device.device_memory import IPC_HANDLE_BYTES
from gmijax.collectives.device_transport import Device


class FakeDeviceMemory:
    """A `CudaMemory` that processes of one user share."""

    def __init__(self) -> None:
        self._mapping: mmap.mmap | None = None

    def create(self, num_bytes: int) -> bytes:
        fd = os.memfd_create("fake-device-memory", os.MFD_CLOEXEC)
        os.ftruncate(fd, num_bytes)
        self._mapping = mmap.mmap(fd, num_bytes)
        return struct.pack("=qqq", os.getpid(), fd, num_bytes).ljust(IPC_HANDLE_BYTES, b"\xff")

    def open(self, ipc_handle: bytes) -> None:
        pid, fd, num_bytes = struct.unpack_from("=qqq", ipc_handle)
        opened = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDWR)
        self._mapping = mmap.mmap(opened, num_bytes)
        os.close(opened)

    def write(self, offset: int, values: jax.Array) -> None:
        self._region(offset, values.shape, values.dtype)[...] = np.asarray(values)

    def view(self, offset: int, shape: tuple[int, ...], dtype=np.float32) -> jax.Array:
        region = self._region(offset, shape, np.dtype(dtype))
        view = jax.dlpack.from_dlpack(region, copy=False)
        assert view.unsafe_buffer_pointer() == region.ctypes.data
        return view

    @property
    def address(self) -> int:
        return self._region(0, (1,), np.dtype(np.uint8)).ctypes.data

    def close(self) -> None:
        self._mapping = None

    def _region(self, offset: int, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        assert self._mapping is not None
        return np.frombuffer(self._mapping, dtype, int(np.prod(shape)), offset).reshape(shape)


class FakeQueue:
    """A `CudaQueue` that does at once what it is given, as a stream of its own would."""

    def __init__(self, flags: np.ndarray) -> None:
        self._flags = flags
        self._started_s, self._clocked_s = 0.0, 0.0

    def copy(self, stream: int, target: int, source: int, num_bytes: int) -> None:
        ctypes.memmove(target, source, num_bytes)

    def copy_rows(
        self, stream: int, target: int, source: int, pitch: int, num_bytes: int, rows: int
    ) -> None:
        for row in range(rows):
            ctypes.memmove(target + row * num_bytes, source + row * pitch, num_bytes)

    def clear(self, stream: int, target: int, num_bytes: int) -> None:
        ctypes.memset(target, 0, num_bytes)

    def raise_flag(self, stream: int, rank: int, count: int) -> None:
        self._flags[rank, 0] = count

    def wait_for_flag(self, stream: int, rank: int, count: int) -> None:
        # As a GPU compares, which takes counts for a circle.
        while (int(self._flags[rank, 0]) - count) % 2**32 >= 2**31:
            time.sleep(5e-5)

    def start_clock(self, stream: int) -> None:
        self._started_s = time.monotonic()

    def stop_clock(self, stream: int) -> None:
        self._clocked_s += time.monotonic() - self._started_s

    def clocked_s(self) -> float:
        seconds, self._clocked_s = self._clocked_s, 0.0
        return seconds

    def close(self) -> None:
        pass


class ForgetfulQueue(FakeQueue):
    """Takes what is written and forgets it: the others see nothing of it."""

    def copy(self, stream: int, target: int, source: int, num_bytes: int) -> None:
        del stream, target, source, num_bytes


class FailingQueue(FakeQueue):
    """Takes no copy."""

    def copy(self, stream: int, target: int, source: int, num_bytes: int) -> None:
        raise RuntimeError("CUDA_ERROR_INVALID_VALUE")


def without_queue(flags: np.ndarray) -> FakeQueue:
    """Of a device that takes no such work."""
    raise RuntimeError("CUDA_ERROR_NOT_SUPPORTED")


FAKES = {
    "fake": Device(FakeDeviceMemory, FakeQueue, None),
    "forgetful": Device(FakeDeviceMemory, ForgetfulQueue, None),
    "failing_queue": Device(FakeDeviceMemory, FailingQueue, None),
    "without_queue": Device(FakeDeviceMemory, without_queue, None),
}
