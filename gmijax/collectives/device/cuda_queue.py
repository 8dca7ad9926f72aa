"""Work for a stream of a GPU: copies, and flags in memory of the host, by cuda-bindings."""

from __future__ import annotations

import ctypes
import importlib
import weakref
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from gmijax.errors import CudaError

# By name, because it has no type information, and is not installed everywhere.
runtime: Any = importlib.import_module("cuda.bindings.runtime")
driver: Any = importlib.import_module("cuda.bindings.driver")


class CudaQueue:
    """Work for a stream of the device, which does it in order; all addresses are the device's.

    Copies, and stream memory operations on flags in memory of the host.

    Args:
      flags: [whole pages, line] uint32, shared by processes; not of a file with a name, which
        CUDA does not register.

    Raises:
      CudaError: from every method.
    """

    def __init__(self, flags: npt.NDArray[np.uint32]) -> None:
        self._host, self._line_bytes = flags.ctypes.data, flags.strides[0]
        self._wait = _wait_flags()
        mapped = runtime.cudaHostRegisterMapped | runtime.cudaHostRegisterPortable
        checked(
            runtime.cudaHostRegister(self._host, flags.nbytes, mapped),
            "let the GPU see flags in host memory",
        )
        mapping = runtime.cudaHostGetDevicePointer(self._host, 0)
        if mapping[0] != runtime.cudaError_t.cudaSuccess:
            runtime.cudaHostUnregister(self._host)
        (address,) = checked(mapping, "see flags from the GPU")
        self._flags = int(address)
        self._kind = runtime.cudaMemcpyKind.cudaMemcpyDeviceToDevice
        self._clocks: deque[tuple[Any, Any]] = deque()  # Started and stopped, not yet read.
        self._idle_clocks: list[tuple[Any, Any]] = []
        self._clock: tuple[Any, Any] | None = None

    def copy(self, stream: int, target: int, source: int, num_bytes: int) -> None:
        """Copies bytes."""
        checked(
            runtime.cudaMemcpyAsync(target, source, num_bytes, self._kind, stream), "queue a copy"
        )

    def copy_rows(
        self, stream: int, target: int, source: int, pitch: int, num_bytes: int, rows: int
    ) -> None:
        """Copies `num_bytes` of each row to the next ones in `target`; rows are `pitch` apart."""
        copied = runtime.cudaMemcpy2DAsync(
            target, num_bytes, source, pitch, num_bytes, rows, self._kind, stream
        )
        checked(copied, "queue a copy")

    def clear(self, stream: int, target: int, num_bytes: int) -> None:
        """Sets bytes to zero."""
        checked(runtime.cudaMemsetAsync(target, 0, num_bytes, stream), "clear memory")

    def raise_flag(self, stream: int, rank: int, count: int) -> None:
        """Sets a flag once all work before it is done and visible to readers of the flag."""
        # No flags: with the barrier that makes what was written before visible to all.
        flag = self._flags + rank * self._line_bytes
        _queued(driver.cuStreamWriteValue32(stream, flag, count, 0), "write")

    def wait_for_flag(self, stream: int, rank: int, count: int) -> None:
        """Holds the stream until a flag has reached `count`."""
        flag = self._flags + rank * self._line_bytes
        _queued(driver.cuStreamWaitValue32(stream, flag, count, self._wait), "wait for")

    def start_clock(self, stream: int) -> None:
        """From here on the stream's time counts, until `stop_clock`."""
        self._clock = self._idle_clocks.pop() if self._idle_clocks else (_event(), _event())
        checked(runtime.cudaEventRecord(self._clock[0], stream), "record an event")

    def stop_clock(self, stream: int) -> None:
        """See `start_clock`."""
        assert self._clock is not None
        checked(runtime.cudaEventRecord(self._clock[1], stream), "record an event")
        self._clocks.append(self._clock)

    def clocked_s(self) -> float:
        """Seconds of clocks that count and have stopped since the last call."""
        total_ms = 0.0
        success = runtime.cudaError_t.cudaSuccess
        while self._clocks and runtime.cudaEventQuery(self._clocks[0][1])[0] == success:
            clock = self._clocks.popleft()
            total_ms += checked(runtime.cudaEventElapsedTime(*clock), "read an event")[0]
            self._idle_clocks.append(clock)
        return total_ms / 1e3

    def close(self) -> None:
        """Gives the flags back. Idempotent."""
        if self._host:
            runtime.cudaHostUnregister(self._host)
            self._host = 0


def _wait_flags() -> int:
    """How to wait for a flag that other GPUs set after writing into memory of this one."""
    can_flush = runtime.cudaDeviceAttr.cudaDevAttrCanFlushRemoteWrites
    (is_able,) = checked(runtime.cudaDeviceGetAttribute(can_flush, 0), "ask what the GPU can do")
    flags = driver.CUstreamWaitValue_flags
    wait = int(flags.CU_STREAM_WAIT_VALUE_GEQ.value)
    # Data sent over PCIe before the flag may not have arrived when the flag has.
    return wait | int(flags.CU_STREAM_WAIT_VALUE_FLUSH.value) if is_able else wait


def checked(result: tuple[Any, ...], action: str) -> tuple[Any, ...]:
    """What a call of the runtime returned, without its error code.

    Raises:
      CudaError: it is an error; the message is "cannot `action`", and the error.
    """
    code, *values = result
    if code != runtime.cudaError_t.cudaSuccess:
        message = runtime.cudaGetErrorString(code)[1].decode()
        raise CudaError(f"cannot {action}: {code.name}: {message}")
    return tuple(values)


def _queued(result: tuple[Any, ...], action: str) -> None:
    if result[0] != driver.CUresult.CUDA_SUCCESS:
        raise CudaError(f"cannot {action} a flag on the stream: {result[0].name}")


def _event() -> Any:
    return checked(runtime.cudaEventCreate(), "make an event")[0]


def pinned(num_floats: int) -> npt.NDArray[np.float32]:
    """New memory of the host, [n], that the GPU reads and writes by itself.

    Copies from and to other memory go through a buffer of the driver, piece by piece. It is
    released with the last array of it: an interrupted call may leave a thread that still uses it.
    """
    allocated = runtime.cudaHostAlloc(4 * num_floats, runtime.cudaHostAllocPortable)
    (address,) = checked(allocated, "pin memory of the host")
    memory = (ctypes.c_float * num_floats).from_address(int(address))
    weakref.finalize(memory, runtime.cudaFreeHost, address).atexit = False
    return np.ctypeslib.as_array(memory)


def fetch(stream: int, source: int, target: npt.NDArray[np.float32]) -> None:
    """Copies [n] float32 of the device to `target`, after the work queued on the stream."""
    kind = runtime.cudaMemcpyKind.cudaMemcpyDeviceToHost
    copied = runtime.cudaMemcpyAsync(target.ctypes.data, source, target.nbytes, kind, stream)
    checked(copied, "copy from the GPU")
    synchronize(stream)


def store(stream: int, target: int, values: npt.NDArray[np.float32]) -> None:
    """Copies `values` to the device; they may be used again on return."""
    kind = runtime.cudaMemcpyKind.cudaMemcpyHostToDevice
    copied = runtime.cudaMemcpyAsync(target, values.ctypes.data, values.nbytes, kind, stream)
    checked(copied, "copy to the GPU")
    synchronize(stream)


def synchronize(stream: int) -> None:
    """Waits until the device has done what the stream was given."""
    checked(runtime.cudaStreamSynchronize(stream), "wait for the GPU")
