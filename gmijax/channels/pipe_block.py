"""The block of shared memory that holds a pipe for every ordered pair of K processes.

The controller makes it (`create_pipes`) and hands the descriptor down; every process maps it
(`PipeBlock`). It is sparse: a pipe costs memory from the moment its writer opens it.

Wire format (K ranks, capacity C rounded up to whole pages, native byte order):

| offset | content |
|---|---|
| 0 | 64 bytes, `HEAD`, written by the controller |
| 64 | K lines of 64 bytes, `LINE`, each written by its own rank only |
| next page + (src K + dst) (C + page) | the pipe from src to dst |

A pipe is a page with two lines of 64 bytes, `END`, the writer's and the reader's, followed by a
ring of C bytes. What is in the ring: `pipe_format.py`.
"""

from __future__ import annotations

import mmap
import os
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.shared_memory import create_file, fence, process_of, take_line, whole_pages
from gmijax.errors import CollectiveError, GmijaxError, PeerLost, PipeClosed

LINE_BYTES = 64

HEAD = np.dtype([("world_size", np.uint64), ("capacity_bytes", np.uint64)])
LINE = np.dtype(
    [
        ("pid", np.uint64),  # 0 until the rank has come
        ("start_ticks", np.uint64),
        ("has_left", np.uint64),  # by itself: no rank reports it as lost
        ("pad", np.uint64, (5,)),
    ]
)
END = np.dtype(
    [
        ("position", np.uint64),  # bytes ever committed or released
        ("messages", np.uint64),  # ever released; the reader's only
        ("closed", np.uint64),
        ("pad", np.uint64, (5,)),
    ]
)
"""How far one end of a pipe is; exactly one cache line, so that the ends share none."""


class PipeMemory(NamedTuple):
    """One pipe as arrays: `writer` and `reader` [1] of `END`, `ring` [C] of bytes."""

    writer: npt.NDArray[np.void]
    reader: npt.NDArray[np.void]
    ring: npt.NDArray[np.uint8]


def create_pipes(world_size: int, capacity_bytes: int) -> int:
    """Makes an empty block for K processes and returns its descriptor, for the controller.

    Pipes of `capacity_bytes` are rounded up to whole pages; a message may take half of one.
    """
    capacity_bytes = whole_pages(capacity_bytes)
    fd = create_file("pipes", _block_bytes(world_size, capacity_bytes))
    head = np.array([(world_size, capacity_bytes)], HEAD)
    os.pwrite(fd, head.tobytes(), 0)
    return fd


class PipeBlock:
    """One process's view of all pipes of capacity C, from which the others know it as `rank`.

    The caller keeps the descriptor from `create_pipes` and may close it at once.

    Raises:
      CollectiveError: no such block, or the rank is taken.
    """

    def __init__(self, fd: int, rank: int) -> None:
        try:
            head = np.frombuffer(os.pread(fd, HEAD.itemsize, 0), HEAD)[0].item()
            self.world_size, self.capacity_bytes = head
            size = _block_bytes(self.world_size, self.capacity_bytes)
            mapping = mmap.mmap(fd, size, flags=mmap.MAP_SHARED)
        except (OSError, ValueError, IndexError) as error:  # IndexError: an empty file.
            raise CollectiveError(f"GMI {rank}: no pipes at descriptor {fd} ({error})") from None
        self.rank = rank
        self._lines = np.frombuffer(mapping, LINE, self.world_size, LINE_BYTES)
        self._pipes: dict[tuple[int, int], PipeMemory] = {}
        take_line(self._lines[rank], rank)
        self._fd = os.dup(fd)
        self._mapping: mmap.mmap | None = mapping

    def why_lost(self, peer: int, operation: str, step: int) -> GmijaxError | None:
        """PipeClosed if `peer` has left, PeerLost if its process is gone; None if it may come."""
        line = self._lines[peer]
        is_gone = line["pid"] and not process_of(line).is_running()
        if line["has_left"]:
            return PipeClosed(self.rank, peer, operation)
        return PeerLost(self.rank, peer, operation, step) if is_gone else None

    def outstanding_bytes(self, dst: int) -> int:
        """Bytes on the way to `dst` from all ranks, with what it holds and has not released."""
        total = 0
        for src in range(self.world_size):
            pipe = self.pipe(src, dst)
            # The reader first: it never overtakes the writer.
            tail = pipe.reader["position"].item(0)
            total += pipe.writer["position"].item(0) - tail
        return total

    def pipe(self, src: int, dst: int) -> PipeMemory:
        """The pipe from `src` to `dst`; for `pipe.py`."""
        if self._mapping is None:
            raise CollectiveError(f"GMI {self.rank}: pipe after close")
        if (src, dst) not in self._pipes:
            offset = self._offset(src, dst)
            ends = np.frombuffer(self._mapping, END, 2, offset)
            begin = offset + mmap.PAGESIZE
            ring = np.frombuffer(self._mapping, np.uint8, self.capacity_bytes, begin)
            self._pipes[src, dst] = PipeMemory(ends[:1], ends[1:], ring)
        return self._pipes[src, dst]

    def allocate(self, dst: int) -> None:
        """Gives the pipe from this rank to `dst` its memory; CollectiveError if there is none."""
        size = mmap.PAGESIZE + self.capacity_bytes
        try:
            # A lack of memory shows here and not at the first touch, which would kill us.
            os.posix_fallocate(self._fd, self._offset(self.rank, dst), size)
        except OSError as error:
            raise CollectiveError(
                f"GMI {self.rank}: cannot have {size / 2**20:.1f} MiB of shared memory for a "
                f"pipe to GMI {dst} ({error.strerror})"
            ) from None

    def close(self) -> None:
        """Leaves: no rank will report this one as lost. Idempotent."""
        if self._mapping is not None:
            fence()
            self._lines["has_left"][self.rank] = 1
            os.close(self._fd)
            self._pipes.clear()
            self._mapping = None  # Unmapped with the last array on it.

    def _offset(self, src: int, dst: int) -> int:
        index = src * self.world_size + dst
        return _lines_end(self.world_size) + index * (self.capacity_bytes + mmap.PAGESIZE)


def _lines_end(world_size: int) -> int:
    return whole_pages(LINE_BYTES * (1 + world_size))


def _block_bytes(world_size: int, capacity_bytes: int) -> int:
    return _lines_end(world_size) + world_size**2 * (capacity_bytes + mmap.PAGESIZE)
