"""Registers in shared memory: one writer each, any number of readers, nobody ever waits.

A register holds the newest value only. It is a seqlock with two buffers, written in turn: a reader
that copies one is disturbed only if the writer begins to publish for the second time meanwhile,
which a counter tells it. The order of memory accesses is kept by `Fence`.

    fd = create_registers()                             # the controller
    registers = open_registers(fd, [64, 4096])          # every process, with the same sizes
    registers[1].publish(array, tag=7)                  # the one writer of register 1
    registers[1].read(after=0)                          # anybody: None if nothing is newer

Wire format (native byte order): a line of 64 bytes (`LINE`) for every register, then for every
register two buffers of its size, each on pages of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gmijax.collectives.shared_memory import Fence, create_file, map_file, whole_pages

LINE = np.dtype(
    [
        ("count", np.uint64),  # how often the register was published
        ("begun", np.uint64),  # how often that was begun: `count`, or one more
        ("tag", np.uint64, (2,)),
        ("length", np.uint64, (2,)),
        ("pad", np.uint64, (2,)),
    ]
)

_LOOKS = 3


class Snapshot(NamedTuple):
    """The newest value of a register: a copy of its bytes, [length] uint8, and the writer's tag.

    `count` says how often the register had been published; give it to the next `read`.
    """

    count: int
    tag: int
    values: npt.NDArray[np.uint8]


class AnyRegister(Protocol):
    """A register in shared memory, or one that other nodes have too."""

    def publish(self, values: npt.NDArray[Any], tag: int = 0) -> None:
        """See `Register`."""
        ...

    def read(self, after: int = 0) -> Snapshot | None:
        """See `Register`."""
        ...


class Register:
    """One register; see the module."""

    def __init__(self, line: npt.NDArray[np.void], buffers: npt.NDArray[np.uint8]) -> None:
        self._line = line
        self._buffers = buffers
        self._fence = Fence()

    def publish(self, values: npt.NDArray[Any], tag: int = 0) -> None:
        """Replaces the value; one process only may do so. Costs a copy."""
        data = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        count = int(self._line["count"][0]) + 1
        buffer = count % 2
        self._line["begun"][0] = count
        self._fence()  # Who sees anything of what follows sees that it was begun.
        self._buffers[buffer, : data.size] = data
        self._line["tag"][0, buffer] = tag
        self._line["length"][0, buffer] = data.size
        self._fence()
        self._line["count"][0] = count

    def read(self, after: int = 0) -> Snapshot | None:
        """The newest value if it was published after the `after`-th, else None; never waits.

        None, too, if the writer was faster three times over: the next call finds a newer one.
        """
        for _ in range(_LOOKS):
            count = int(self._line["count"][0])
            if count <= after:
                return None
            self._fence()
            buffer = count % 2
            length = int(self._line["length"][0, buffer])
            tag = int(self._line["tag"][0, buffer])
            values = self._buffers[buffer, :length].copy()
            self._fence()
            # The next publication goes into the other buffer.
            if int(self._line["begun"][0]) - count < 2:
                return Snapshot(count, tag, values)
        return None


def create_registers() -> int:
    """Makes the memory of the registers and returns its descriptor, for the controller."""
    return create_file("registers")


def open_registers(fd: int, sizes_bytes: Sequence[int]) -> list[Register]:
    """Maps registers of such sizes; the caller keeps `fd` and may close it at once.

    Raises:
      CollectiveError: no memory.
    """
    sizes = [whole_pages(size) for size in sizes_bytes]
    offset = whole_pages(len(sizes) * LINE.itemsize)
    mapping = map_file(fd, offset + 2 * sum(sizes), "registers")
    lines = np.frombuffer(mapping, LINE, len(sizes))
    registers = []
    for index, (size, room) in enumerate(zip(sizes_bytes, sizes, strict=True)):
        buffers = np.frombuffer(mapping, np.uint8, 2 * room, offset).reshape(2, room)
        registers.append(Register(lines[index : index + 1], buffers[:, :size]))
        offset += 2 * room
    return registers
