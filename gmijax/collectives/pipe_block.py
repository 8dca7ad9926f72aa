"""The block of shared memory that holds a pipe for every ordered pair of K processes.

The controller makes an anonymous file (`create_pipes`) and hands the descriptor down; every
process maps it (`PipeBlock.attach`). The file is sparse: a pipe costs memory from the moment
its writer opens it. Nothing has a name, so that nothing is left behind whoever gets killed.

Wire format (K ranks, capacity C rounded up to whole pages, native byte order):

| offset | content |
|---|---|
| 0 | 64 bytes, `HEAD`, written by the controller |
| 64 | K lines of 64 bytes, `LINE`, each written by its own rank only |
| next page + (src K + dst) (C + page) | the pipe from src to dst |

A pipe is a page with two lines of 64 bytes, `END`, the writer's and the reader's, followed by a
ring of C bytes. What is in the ring: `gmijax.collectives.pipe`.
"""

from __future__ import annotations

import mmap
import os
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.waits import fence
from gmijax.errors import CollectiveError, ConfigError, GmijaxError, PeerLost, PipeClosed
from gmijax.processes import ProcessId, own_process
from gmijax.schema import require_at_least, require_between

MAGIC = 0x50494D47  # "GMIP" in memory on a little-endian machine
VERSION = 1
LINE_BYTES = 64

HEAD = np.dtype(
    [
        ("magic", np.uint32),
        ("version", np.uint32),
        ("world_size", np.uint64),
        ("capacity_bytes", np.uint64),
    ]
)
LINE = np.dtype(
    [
        ("pid", np.uint64),  # 0 once the rank has left by itself
        ("start_ticks", np.uint64),
        ("attached", np.uint64),  # how often a process took this rank
        ("pad", np.uint64, (5,)),
    ]
)
END = np.dtype(
    [
        ("position", np.uint64),  # bytes ever written or read; what counts
        ("record", np.uint64, (2, 3)),  # (position, messages, items), by parity of messages
        ("closed", np.uint64),
    ]
)
"""How far one end of a pipe has come; exactly one cache line, so that the ends share none.

The position is stored last, and the two records in turn, so that the one that bears the present
position is whole even if the process was killed in between. A successor goes on from there.
"""


class Progress(NamedTuple):
    """How far one end of a pipe has come since the block was made.

    Attributes:
      position: bytes, with headers and gaps.
      messages: messages committed (writer) or released (reader).
      items: what the writer counted in them; see `PipeWriter.commit`.
    """

    position: int
    messages: int
    items: int


class PipeMemory(NamedTuple):
    """One pipe as arrays: `writer` and `reader` [1] of `END`, `ring` [C] of bytes."""

    writer: npt.NDArray[np.void]
    reader: npt.NDArray[np.void]
    ring: npt.NDArray[np.uint8]


def create_pipes(world_size: int, capacity_bytes: int) -> int:
    """Makes an empty block and returns its descriptor, for the controller.

    Args:
      world_size: K, number of processes.
      capacity_bytes: of every pipe, rounded up to whole pages; a message may take half of it.

    Raises:
      ConfigError: numbers that make no sense.
    """
    require_pipes(world_size, capacity_bytes)
    fd = os.memfd_create("gmijax-pipes", os.MFD_CLOEXEC)
    # Another user who may look into /proc/<pid>/fd must not read or change anything.
    os.fchmod(fd, 0o600)
    os.ftruncate(fd, _size(world_size, capacity_bytes))
    head = np.array([(MAGIC, VERSION, world_size, _round_up(capacity_bytes))], HEAD)
    os.pwrite(fd, head.tobytes(), 0)
    return fd


def require_pipes(world_size: int, capacity_bytes: int) -> None:
    """Raises ConfigError unless a block of such numbers makes sense."""
    require_at_least("world_size", world_size, 1)
    require_between("capacity_bytes", capacity_bytes, mmap.PAGESIZE, 2**40)


class PipeBlock:
    """One process's view of all pipes. Make it with `attach`.

    Attributes:
      rank: whose view this is.
      world_size: K.
      capacity_bytes: C, of every pipe.
    """

    def __init__(self, fd: int, mapping: mmap.mmap, rank: int, head: npt.NDArray[np.void]) -> None:
        self.rank = rank
        self.world_size = int(head["world_size"][0])
        self.capacity_bytes = int(head["capacity_bytes"][0])
        self._fd = fd
        self._mapping: mmap.mmap | None = mapping
        self._memory: dict[tuple[int, int], PipeMemory] = {}
        self._lines = np.frombuffer(mapping, LINE, self.world_size, LINE_BYTES)

    @classmethod
    def attach(cls, fd: int, rank: int, world_size: int, capacity_bytes: int) -> PipeBlock:
        """Maps the block and makes this process known as `rank`.

        A rank whose process has ended can be taken again: its pipes go on after the last
        message that was committed (writing) or released (reading). The caller keeps `fd` and
        may close it at once.

        Args:
          fd: descriptor from `create_pipes`.
          rank: 0 to `world_size - 1`.
          world_size: K, as the controller said.
          capacity_bytes: as the controller said.

        Raises:
          ConfigError: numbers that make no sense.
          CollectiveError: no such block, made with other numbers, or the rank is taken.
        """
        require_pipes(world_size, capacity_bytes)
        if not 0 <= rank < world_size:
            raise ConfigError(f"rank={rank}: must be 0 to world_size - 1 = {world_size - 1}")
        try:
            head = np.frombuffer(os.pread(fd, HEAD.itemsize, 0), HEAD)
            wanted = (MAGIC, VERSION, world_size, _round_up(capacity_bytes))
            if head[0].item() != wanted:
                raise CollectiveError(
                    f"rank {rank}: descriptor {fd} has pipes (magic, version, world_size, "
                    f"capacity_bytes) = {head[0].item()}, expected {wanted}"
                )
            mapping = mmap.mmap(fd, _size(world_size, capacity_bytes), flags=mmap.MAP_SHARED)
            own_fd = os.dup(fd)
        except (OSError, ValueError, IndexError) as error:  # IndexError: an empty file.
            raise CollectiveError(f"rank {rank}: no pipes at descriptor {fd} ({error})") from None
        block = cls(own_fd, mapping, rank, head)
        try:
            block._take_rank()
        except CollectiveError:
            os.close(own_fd)
            raise
        return block

    def is_gone(self, peer: int) -> bool:
        """Whether the process of `peer` has ended without leaving; not if it may still come."""
        process = self.process_of(peer)
        return process is not None and not process.is_running()

    def has_left(self, peer: int) -> bool:
        """Whether `peer` was there and closed its block."""
        line = self._lines[peer]
        attached = line["attached"]
        fence()  # See `_take_rank`.
        return bool(attached) and not line["pid"]

    def process_of(self, peer: int) -> ProcessId | None:
        """The process behind `peer`, running or not; None before it comes and after it leaves."""
        line = self._lines[peer]
        pid = int(line["pid"])
        fence()  # See `_take_rank`.
        return ProcessId(pid, int(line["start_ticks"])) if pid else None

    def why_lost(self, peers: tuple[int, ...], operation: str, step: int) -> GmijaxError | None:
        """PeerLost or PipeClosed for the first of `peers` that is gone or left; for waits."""
        for peer in peers:
            if self.is_gone(peer):
                return PeerLost(self.rank, peer, operation, step)
            if self.has_left(peer):
                return PipeClosed(self.rank, peer, operation)
        return None

    def written(self, src: int, dst: int) -> Progress:
        """How far the writer of the pipe from `src` to `dst` has come."""
        return progress_of(self.memory(src, dst).writer)

    def read(self, src: int, dst: int) -> Progress:
        """How far the reader of the pipe from `src` to `dst` has come."""
        return progress_of(self.memory(src, dst).reader)

    def outstanding_bytes(self, dst: int) -> int:
        """Bytes on the way to `dst` from all ranks, with what it holds and has not released."""
        total = 0
        for src in range(self.world_size):
            memory = self.memory(src, dst)
            # The reader first: it never overtakes the writer.
            tail = memory.reader["position"].item(0)
            total += memory.writer["position"].item(0) - tail
        return total

    def memory(self, src: int, dst: int) -> PipeMemory:
        """The pipe from `src` to `dst` as arrays; for `gmijax.collectives.pipe`."""
        if self._mapping is None:
            raise CollectiveError(f"rank {self.rank}: pipe after close")
        if (src, dst) not in self._memory:
            offset = self._offset(src, dst)
            ends = np.frombuffer(self._mapping, END, 2, offset)
            begin = offset + mmap.PAGESIZE
            ring = np.frombuffer(self._mapping, np.uint8, self.capacity_bytes, begin)
            self._memory[src, dst] = PipeMemory(ends[:1], ends[1:], ring)
        return self._memory[src, dst]

    def allocate(self, src: int, dst: int) -> None:
        """Gives the pipe from `src` to `dst` its memory.

        Raises:
          CollectiveError: there is not enough.
        """
        size = mmap.PAGESIZE + self.capacity_bytes
        try:
            # A lack of memory shows here and not at the first touch, which would kill us.
            os.posix_fallocate(self._fd, self._offset(src, dst), size)
        except OSError as error:
            raise CollectiveError(
                f"rank {self.rank}: cannot have {size / 2**20:.1f} MiB of shared memory for a "
                f"pipe to rank {dst} ({error.strerror})"
            ) from None

    def close(self) -> None:
        """Leaves: nobody will call this rank lost. Calling it twice is fine."""
        if self._mapping is not None:
            self._lines["pid"][self.rank] = 0
            os.close(self._fd)
            self._memory.clear()
            self._mapping = None  # Unmapped with the last array on it.

    def _offset(self, src: int, dst: int) -> int:
        for rank in (src, dst):
            if not 0 <= rank < self.world_size:
                raise ConfigError(f"rank={rank}: must be 0 to {self.world_size - 1}")
        place = src * self.world_size + dst
        return _lines_end(self.world_size) + place * (self.capacity_bytes + mmap.PAGESIZE)

    def _take_rank(self) -> None:
        line = self._lines[self.rank]
        holder = self.process_of(self.rank)
        if holder is not None and holder.is_running():
            raise CollectiveError(f"rank {self.rank} is taken already by process {holder.pid}")
        process = own_process()
        # A pid with another start would seem to be a process that is gone, and a count with no
        # pid one that has left. Who looks reads them in the opposite order.
        line["start_ticks"] = process.start_ticks
        fence()
        line["pid"] = process.pid
        fence()
        line["attached"] += 1


def progress_of(end: npt.NDArray[np.void]) -> Progress:
    """What one end of a pipe says of itself, read by whomever while it may change."""
    while True:
        position = end["position"].item(0)
        fence()  # Its record was written before it.
        records = end["record"][0].tolist()
        fence()  # And is not written again before it has moved.
        for record in records:
            if record[0] == position == end["position"].item(0):
                return Progress(*record)


def _lines_end(world_size: int) -> int:
    return _round_up(LINE_BYTES * (1 + world_size))


def _size(world_size: int, capacity_bytes: int) -> int:
    pipe = _round_up(capacity_bytes) + mmap.PAGESIZE
    return _lines_end(world_size) + world_size**2 * pipe


def _round_up(num_bytes: int) -> int:
    return -(-num_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
