"""Registers in shared memory: one writer each, any number of readers, no waiting.

A register holds the newest value only. It is a seqlock with two buffers, written in turn: a reader
that copies one is disturbed only if the writer begins to publish for the second time meanwhile,
which a counter shows. The order of memory accesses is kept by `Fence`.

    fd = create_registers()                             # the controller
    registers = open_registers(fd, [64, 4096])          # every process, with the same sizes
    registers[1].publish(array, tag=7)                  # the one writer of register 1
    registers[1].read(after=0)                          # anybody: None if nothing is newer

Wire format (native byte order): a line of 64 bytes (`LINE`) for every register, then for every
register two buffers of its size, each on pages of its own.

Between nodes the newest values travel by TCP (`RemoteRegisters`), without waiting either.

    mine = RemoteRegisters(0, {7: address}, [64, 4096], [16], listens=False, secret=secret)
    mine.own(1).publish(array, tag=7)                   # to all of `addresses`
    mine.of(7, 0).read(after=0)                         # None if nothing is newer

A publish sends the newest values of all registers of the writer in one message. Of the messages
that wait, at either end, the last one alone is kept: a reader that comes seldom gets what is
newest, and takes no memory meanwhile. Wire format: for every register of the sender `_HEAD`, then
their bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gmijax.channels.pipe_format import Bytes
from gmijax.channels.tcp_connection import Connection
from gmijax.collectives.shared_memory import Fence, create_file, map_file, whole_pages
from gmijax.errors import CollectiveError

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

    `count` is how often the register had been published; give it to the next `read`.
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
        self._fence()  # A reader of anything that follows sees that it was begun.
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
    for index, (size, padded) in enumerate(zip(sizes_bytes, sizes, strict=True)):
        buffers = np.frombuffer(mapping, np.uint8, 2 * padded, offset).reshape(2, padded)
        registers.append(Register(lines[index : index + 1], buffers[:, :size]))
        offset += 2 * padded
    return registers


_HEAD: Final = struct.Struct("<QqQ")
"""How often it was published, its tag, its length in bytes."""


class RemoteRegisters:
    """The registers of this process that others read, and theirs.

    Args:
      rank: of this process, for messages.
      addresses: of the connection with each of the others, `host:port` by rank.
      own_bytes: sizes of its registers.
      their_bytes: sizes of the registers of each of the others.
      listens: whether it listens at the addresses, or calls.
      secret: of the job.

    Raises:
      CollectiveError: an address that cannot be.
    """

    def __init__(
        self,
        rank: int,
        addresses: Mapping[int, str],
        own_bytes: Sequence[int],
        their_bytes: Sequence[int],
        *,
        listens: bool,
        secret: bytes,
    ) -> None:
        self._rank, self._their_bytes = rank, their_bytes
        longest = _HEAD.size * len(their_bytes) + sum(their_bytes)
        self._connections = {
            peer: Connection(
                *(address, rank, peer, longest), listens=listens, secret=secret, newest_only=True
            )
            for peer, address in addresses.items()
        }
        self._own = [_nothing() for _ in own_bytes]
        self._theirs = {peer: [_nothing() for _ in their_bytes] for peer in addresses}

    def own(self, index: int, local: AnyRegister | None = None) -> RemoteRegister:
        """A register of this process; `local` is for readers of its node."""
        return RemoteRegister(self, index, None, local)

    def of(self, peer: int, index: int) -> RemoteRegister:
        """A register of `peer`."""
        return RemoteRegister(self, index, peer, None)

    def publish(self, index: int, values: npt.NDArray[Any], tag: int) -> None:
        """See `Register`; those that are not there yet get it with the next one."""
        data = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        self._own[index] = Snapshot(self._own[index].count + 1, tag, data.copy())
        heads = [_HEAD.pack(one.count, one.tag, one.values.size) for one in self._own]
        message = b"".join([*heads, *(one.values.data for one in self._own)])
        for connection in self._connections.values():
            connection.send([message])

    def read(self, peer: int, index: int, after: int) -> Snapshot | None:
        """See `Register`.

        Raises:
          CollectiveError: what came is no message of such registers.
        """
        while (found := self._connections[peer].try_receive()) is not None:
            self._theirs[peer] = self._unpacked(peer, found)
        newest = self._theirs[peer][index]
        return newest if newest.count > after else None

    def close(self) -> None:
        """Leaves, once the others have what was published last. Idempotent."""
        for connection in self._connections.values():
            connection.close()

    def _unpacked(self, peer: int, parts: Sequence[Bytes]) -> list[Snapshot]:
        """The values of a message, which stay in its memory."""
        data = parts[0] if len(parts) == 1 else np.empty(0, np.uint8)
        begin = _HEAD.size * len(self._their_bytes)
        found: list[Snapshot] = []
        if data.size >= begin:
            heads = _HEAD.iter_unpack(data[:begin].data)
            for (count, tag, length), most in zip(heads, self._their_bytes, strict=True):
                if length <= min(most, data.size - begin):
                    found.append(Snapshot(count, tag, data[begin : begin + length]))
                    begin += length
        if len(found) < len(self._their_bytes) or begin != data.size:
            # Authenticated: only a GMI of this job has the secret.
            raise CollectiveError(f"GMI {self._rank}: no message of registers from GMI {peer}")
        return found


class RemoteRegister:
    """One of `RemoteRegisters`, as a `Register`: one end writes it, the other reads."""

    def __init__(
        self, registers: RemoteRegisters, index: int, peer: int | None, local: AnyRegister | None
    ) -> None:
        self._registers, self._index = registers, index
        self._peer, self._local = peer, local

    def publish(self, values: npt.NDArray[Any], tag: int = 0) -> None:
        """See `Register`."""
        if self._local is not None:
            self._local.publish(values, tag)
        self._registers.publish(self._index, values, tag)

    def read(self, after: int = 0) -> Snapshot | None:
        """See `Register`."""
        assert self._peer is not None
        return self._registers.read(self._peer, self._index, after)


def _nothing() -> Snapshot:
    return Snapshot(0, 0, np.zeros(0, np.uint8))
