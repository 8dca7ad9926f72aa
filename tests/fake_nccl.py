"""NCCL without GPUs, for `gmijax.collectives.device.nccl_ring`: a file without a name, and waits.

A call waits for the other members for ever, as a GPU does for one that is gone.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import struct
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np

MAX_FLOATS = 1 << 17
_COUNTERS_BYTES = 4096


class FakeComm:
    """One member's view of the file: a counter and a slot for each."""

    def __init__(self, size: int, unique: bytes, rank: int) -> None:
        pid, fd = struct.unpack_from("=qq", unique)
        opened = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDWR)
        num_bytes = _COUNTERS_BYTES + 4 * size * MAX_FLOATS
        os.ftruncate(opened, num_bytes)
        mapping = mmap.mmap(opened, num_bytes)
        os.close(opened)
        self.rank = rank
        self.counters = np.frombuffer(mapping, np.uint64, size)
        slots = np.frombuffer(mapping, np.float32, size * MAX_FLOATS, _COUNTERS_BYTES)
        self.slots = slots.reshape(size, MAX_FLOATS)
        self.wait_for_all()

    def wait_for_all(self) -> None:
        self.counters[self.rank] += 1
        while self.counters.min() < self.counters[self.rank]:
            time.sleep(5e-5)

    def gathered(self, source: int, num_floats: int) -> np.ndarray:
        """[m, n]: what all members have; nobody writes again before all have come here."""
        self.slots[self.rank, :num_floats] = _at(source, num_floats)
        self.wait_for_all()
        rows = self.slots[:, :num_floats].copy()
        self.wait_for_all()
        return rows


class FakeNccl:
    """What a ring uses of the module `nccl.bindings.nccl`; without a network it does not start."""

    DataType, RedOp = SimpleNamespace(Float32=7), SimpleNamespace(Sum=0)
    UniqueId = SimpleNamespace(from_buffer=bytes)

    def __init__(self, *, has_network: bool) -> None:
        self._has_network = has_network

    def get_unique_id(self) -> bytes:
        fd = os.memfd_create("fake-nccl", os.MFD_CLOEXEC)
        return struct.pack("=qq", os.getpid(), fd).ljust(128, b"\xff")

    def comm_init_rank(self, size: int, unique: bytes, rank: int) -> FakeComm:
        if not self._has_network:
            raise RuntimeError("ncclSystemError")
        return FakeComm(size, unique, rank)

    def all_reduce(self, source: int, target: int, count: int, *rest: Any) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            _at(target, count)[:] = rest[2].gathered(source, count).sum(axis=0)

    def all_gather(self, source: int, target: int, count: int, *rest: Any) -> None:
        rows = rest[1].gathered(source, count)
        _at(target, rows.size)[:] = rows.ravel()

    def broadcast(self, source: int, target: int, count: int, *rest: Any) -> None:
        _at(target, count)[:] = rest[2].gathered(source, count)[0]

    def comm_destroy(self, comm: FakeComm) -> None:
        del comm


def install(*, has_network: bool = True) -> None:
    """Puts it where `nccl_ring` looks, in this process."""
    sys.modules["nccl.bindings.nccl"] = FakeNccl(has_network=has_network)


def _at(address: int, num_floats: int) -> np.ndarray:
    return np.ctypeslib.as_array((ctypes.c_float * num_floats).from_address(address))
