"""A board of notes in shared memory: one writer each, any number of readers, nobody ever waits.

A note holds the newest value only. Its writer has two places and writes them in turn, so that a
reader that copies one is disturbed only if the writer begins to publish for the second time
meanwhile; a counter of what was begun tells it so, and it looks again, or leaves it for later (a
seqlock with two places). Made for weights: trainers publish them when they have new ones, agents
look between two unrolls. On the order of memory accesses: `gmijax.collectives.waits.Fence`.

    fd = create_board()                              # the controller
    notes = attach_board(fd, sizes_bytes=[64, 4096])   # every process, with the same sizes
    notes[1].publish(array, tag=7)                   # the one writer of note 1
    notes[1].read(after=0)                           # anybody: Posted, or None if nothing newer

Wire format (native byte order): a line of 64 bytes (`LINE`) for every note, then for every note
two places of its size, each on pages of its own.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.waits import Fence
from gmijax.errors import CollectiveError, ConfigError

LINE = np.dtype(
    [
        ("size", np.uint64),  # 0 until somebody attaches
        ("count", np.uint64),  # how often the note was published
        ("begun", np.uint64),  # how often that was begun: `count`, or one more
        ("tag", np.uint64, (2,)),
        ("length", np.uint64, (2,)),
        ("pad", np.uint64, (1,)),
    ]
)

_LOOKS = 3


class Posted(NamedTuple):
    """The newest value of a note.

    Attributes:
      count: how often the note had been published; give it to the next `read`.
      tag: the writer's number for the value.
      values: a copy of its bytes, [length] uint8.
    """

    count: int
    tag: int
    values: npt.NDArray[np.uint8]


class Note:
    """One note; see the module."""

    def __init__(self, line: npt.NDArray[np.void], places: npt.NDArray[np.uint8]) -> None:
        self._line = line
        self._places = places
        self._fence = Fence()

    def publish(self, values: npt.NDArray[Any], tag: int = 0) -> None:
        """Replaces the value; one process only may do so. Costs a copy.

        Raises:
          CollectiveError: more bytes than the note has room for.
        """
        data = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        if data.size > self._places.shape[1]:
            raise CollectiveError(
                f"board: {data.size} bytes for a note of {self._places.shape[1]}"
            )
        count = int(self._line["count"][0]) + 1
        place = count % 2
        self._line["begun"][0] = count
        self._fence()  # Who sees anything of what follows sees that it was begun.
        self._places[place, : data.size] = data
        self._line["tag"][0, place] = tag
        self._line["length"][0, place] = data.size
        self._fence()
        self._line["count"][0] = count

    def read(self, after: int = 0) -> Posted | None:
        """The newest value if it was published after the `after`-th, else None; never waits.

        None, too, if the writer was faster than this reader three times over: the next call
        finds a newer one.
        """
        for _ in range(_LOOKS):
            count = int(self._line["count"][0])
            if count <= after:
                return None
            self._fence()
            place = count % 2
            length = min(int(self._line["length"][0, place]), self._places.shape[1])
            tag = int(self._line["tag"][0, place])
            values = self._places[place, :length].copy()
            self._fence()
            # The next publication goes into the other place.
            if int(self._line["begun"][0]) - count < 2:
                return Posted(count, tag, values)
        return None


def create_board() -> int:
    """Makes an empty board and returns its descriptor, for the controller."""
    fd = os.memfd_create("gmijax-board", os.MFD_CLOEXEC)
    # Another user who may look into /proc/<pid>/fd must not read or change anything.
    os.fchmod(fd, 0o600)
    return fd


def attach_board(fd: int, sizes_bytes: Sequence[int]) -> list[Note]:
    """Maps the board; the caller keeps `fd` and may close it at once.

    Args:
      fd: descriptor from `create_board`.
      sizes_bytes: room of every note, the same for all processes.

    Raises:
      ConfigError: no notes, or a size that makes no sense.
      CollectiveError: no memory, or processes that attach with different sizes.
    """
    if not sizes_bytes or min(sizes_bytes) < 1:
        raise ConfigError(f"sizes_bytes={list(sizes_bytes)}: every note needs at least 1 byte")
    rooms = [_round_up(size, mmap.PAGESIZE) for size in sizes_bytes]
    first = _round_up(len(rooms) * LINE.itemsize, mmap.PAGESIZE)
    total = first + 2 * sum(rooms)
    try:
        # Unlike ftruncate this never shrinks the file under a process that has mapped more.
        os.posix_fallocate(fd, 0, total)
        mapping = mmap.mmap(fd, total, flags=mmap.MAP_SHARED)
    except OSError as error:
        raise CollectiveError(
            f"board: cannot map {total / 2**20:.1f} MiB of shared memory ({error.strerror})"
        ) from None
    notes, offset = [], first
    for index, room in enumerate(rooms):
        line = np.frombuffer(mapping, LINE, 1, index * LINE.itemsize)
        if int(line["size"][0]) not in (0, sizes_bytes[index]):
            raise CollectiveError(
                f"board: note {index} has {line['size'][0]} bytes for another process, "
                f"{sizes_bytes[index]} here"
            )
        line["size"][0] = sizes_bytes[index]
        places = np.frombuffer(mapping, np.uint8, 2 * room, offset).reshape(2, room)
        notes.append(Note(line, places[:, : sizes_bytes[index]]))
        offset += 2 * room
    return notes


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple
