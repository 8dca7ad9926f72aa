"""Compressor: joins the pieces of every channel until a transfer is large enough (section 4.2).

A transfer is one message. Its parts are the spec, a table, and one array a channel into which
the pieces are written side by side along the axis of environments. The memory is the migrator's,
so that a piece is copied once, from the agent's arrays to where the trainer reads it.

All channels of a piece travel in one transfer: a trainer can use none without the others, and a
process that is killed leaves the whole of a transfer or nothing of it.

The table is [1 + k, 2] int64: (room in environments, number of pieces), then for every piece
(its environments, its policy version).
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.channel.dispenser import Piece
from gmijax.collectives.channel.interface import Array, Outlet
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.spec import Spec, arrays_of, write_channel
from gmijax.collectives.channel.transfer_size import TransferSize

ROW_BYTES = 16


class Compressor:
    """Fills transfers with pieces, one transfer at a time.

    Args:
      migrator: gives transfers their way and their memory.
      size: how large they should be.
      max_transfer_bytes: largest sum of all channels and the table's rows for pieces.

    Attributes:
      transfers: number handed over.
      num_bytes: in their channels.
    """

    def __init__(self, migrator: Migrator, size: TransferSize, max_transfer_bytes: int) -> None:
        self.transfers = self.num_bytes = 0
        self._migrator = migrator
        self._size = size
        self._max_transfer_bytes = max_transfer_bytes
        self._open: _Transfer | None = None

    def try_add(self, piece: Piece) -> bool:
        """Puts `piece` into a transfer, if there is room; hands the transfer over when full."""
        if self._open is not None and not self._open.takes(piece):
            self.flush()
        if self._open is None:
            self._open = self._begin(piece)
        if self._open is None:
            return False
        started_s = time.perf_counter()
        self._open.add(piece)
        self._open.spent_s += time.perf_counter() - started_s
        if self._open.is_full:
            self.flush()
        return True

    def flush(self) -> None:
        """Hands over what there is."""
        if self._open is None:
            return
        transfer, self._open = self._open, None
        started_s = time.perf_counter()
        num_bytes = transfer.commit()
        self._size.record(num_bytes, transfer.spent_s + time.perf_counter() - started_s)
        self.transfers += 1
        self.num_bytes += num_bytes

    def _begin(self, piece: Piece) -> _Transfer | None:
        # With its row of the table, which may be larger than a small piece.
        piece_bytes = sum(piece.spec.sizes(piece.num_envs)) + ROW_BYTES
        wanted = min(self._size.num_bytes, self._max_transfer_bytes)
        pieces = max(1, wanted // piece_bytes)
        room, text = pieces * piece.num_envs, piece.spec.encode()
        sizes = [len(text), ROW_BYTES * (1 + pieces), *piece.spec.sizes(room)]
        opened = self._migrator.try_open(sizes)
        if opened is None:
            return None
        outlet, (head, table, *parts) = opened
        head[:] = np.frombuffer(text, np.uint8)
        names = [channel.name for channel in piece.spec.channels]
        arrays = arrays_of(piece.spec, dict(zip(names, parts, strict=True)), room)
        return _Transfer(outlet, piece.spec, table.view(np.int64).reshape(-1, 2), arrays, room)


class _Transfer:
    """A transfer that is being filled."""

    def __init__(
        self,
        outlet: Outlet,
        spec: Spec,
        table: npt.NDArray[np.int64],
        arrays: dict[str, Array],
        room: int,
    ) -> None:
        self.spent_s = 0.0
        self._outlet = outlet
        self._spec = spec
        self._table = table
        self._arrays = arrays
        self._room = room
        self._filled = self._pieces = 0
        table[:] = 0

    @property
    def is_full(self) -> bool:
        return self._filled == self._room or self._pieces == len(self._table) - 1

    def takes(self, piece: Piece) -> bool:
        return piece.spec == self._spec and self._filled + piece.num_envs <= self._room

    def add(self, piece: Piece) -> None:
        low, high = self._filled, self._filled + piece.num_envs
        for name, array in piece.channels.items():
            write_channel(self._arrays[name][:, low:high], array)
        self._filled, self._pieces = high, self._pieces + 1
        self._table[self._pieces] = piece.num_envs, piece.version

    def commit(self) -> int:
        self._table[0] = self._room, self._pieces
        self._outlet.commit(items=self._pieces)
        return sum(self._spec.sizes(self._filled))


class Transfer(NamedTuple):
    """A transfer as the trainer reads it.

    Attributes:
      spec: the channels.
      num_envs: of all pieces together.
      versions: [num_envs] int64.
      arrays: by channel, [S, num_envs, ...] as they travelled; views.
    """

    spec: Spec
    num_envs: int
    versions: npt.NDArray[np.int64]
    arrays: dict[str, Array]


def read_transfer(parts: tuple[Array, ...]) -> Transfer:
    """What a `Compressor` made, from the parts of its message."""
    spec = Spec.decode(parts[0].tobytes())
    table = parts[1].view(np.int64).reshape(-1, 2)
    room, pieces = table[0].tolist()
    counts, versions = table[1 : 1 + pieces].T
    num_envs = int(counts.sum())
    names = [channel.name for channel in spec.channels]
    arrays = arrays_of(spec, dict(zip(names, parts[2:], strict=True)), room)
    filled = {name: array[:, :num_envs] for name, array in arrays.items()}
    return Transfer(spec, num_envs, np.repeat(versions, counts), filled)
