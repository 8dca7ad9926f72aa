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

import statistics
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.channel.dispenser import Piece
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.spec import Array, Spec
from gmijax.collectives.channel.transport import ChannelWriter
from gmijax.collectives.messages.pipe import Message

ROW_BYTES = 16

START_BYTES = 64 * 1024
SAMPLES = 9
WORTH_IT = 0.95
"""A size is better if it takes less than this part of the time per byte."""


class TransferSize:
    """Doubles `num_bytes` as long as a byte gets cheaper, then keeps the best.

    The price of a transfer is fixed plus so much a byte, so that there is no use in going on
    once it has stopped falling; larger transfers only make experience older.
    """

    def __init__(self, max_bytes: int) -> None:
        self.num_bytes = min(START_BYTES, max_bytes)
        self.is_settled = False
        self._max_bytes = max_bytes
        self._samples: list[float] = []
        self._best: tuple[float, int] | None = None

    def record(self, num_bytes: int, seconds: float) -> None:
        """Takes note of what one transfer cost, without the time it waited for room."""
        if self.is_settled or not num_bytes:
            return
        self._samples.append(seconds / num_bytes)
        if len(self._samples) < SAMPLES:
            return
        price, self._samples = statistics.median(self._samples), []
        if self._best is None or price < WORTH_IT * self._best[0]:
            self._best = price, self.num_bytes
            # A transfer that holds one piece already, however large, cannot show more.
            larger = 2 * max(self.num_bytes, num_bytes)
            if larger <= self._max_bytes:
                self.num_bytes = larger
                return
        self.num_bytes, self.is_settled = self._best[1], True


class Compressor:
    """Fills transfers with pieces, one transfer at a time; a `Packer`.

    `max_transfer_bytes` bounds the sum of all channels and the table's rows for pieces.
    """

    def __init__(self, migrator: Migrator, size: TransferSize, max_transfer_bytes: int) -> None:
        self._migrator = migrator
        self._size = size
        self._max_transfer_bytes = max_transfer_bytes
        self._open: _OpenTransfer | None = None

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

    def _begin(self, piece: Piece) -> _OpenTransfer | None:
        # With its row of the table, which may be larger than a small piece.
        piece_bytes = sum(piece.spec.sizes(piece.num_envs)) + ROW_BYTES
        wanted = min(self._size.num_bytes, self._max_transfer_bytes)
        pieces = max(1, wanted // piece_bytes)
        room, head = pieces * piece.num_envs, piece.spec.encode()
        sizes = [head.size, ROW_BYTES * (1 + pieces), *piece.spec.sizes(room)]
        opened = self._migrator.try_open(sizes)
        if opened is None:
            return None
        writer, views = opened
        views[0][:] = head
        table = views[1].view(np.int64).reshape(-1, 2)
        table[:] = 0
        arrays = piece.spec.arrays_in(views[2:], room)
        return _OpenTransfer(writer, piece.spec, table, arrays, room)


@dataclass
class _OpenTransfer:
    """A transfer that is being filled, with `room` for environments."""

    writer: ChannelWriter
    spec: Spec
    table: npt.NDArray[np.int64]
    arrays: dict[str, Array]
    room: int
    filled: int = 0
    pieces: int = 0
    spent_s: float = 0.0

    @property
    def is_full(self) -> bool:
        return self.filled == self.room or self.pieces == len(self.table) - 1

    def takes(self, piece: Piece) -> bool:
        return piece.spec == self.spec and self.filled + piece.num_envs <= self.room

    def add(self, piece: Piece) -> None:
        low, high = self.filled, self.filled + piece.num_envs
        for name, array in piece.channels.items():
            self.arrays[name][:, low:high] = array
        self.filled, self.pieces = high, self.pieces + 1
        self.table[self.pieces] = piece.num_envs, piece.version

    def commit(self) -> int:
        self.table[0] = self.room, self.pieces
        self.writer.commit()
        return sum(self.spec.sizes(self.filled))


class Transfer(NamedTuple):
    """A transfer as the trainer reads it: versions [N] int64, and views [S, N, ...] by channel."""

    spec: Spec
    num_envs: int
    versions: npt.NDArray[np.int64]
    arrays: dict[str, Array]


def read_transfer(message: Message) -> Transfer:
    """What a `Compressor` made; a `Decode`."""
    head, table, *parts = message
    spec, table = Spec.decode(head), table.view(np.int64).reshape(-1, 2)
    room, pieces = table[0].tolist()
    counts, versions = table[1 : 1 + pieces].T
    num_envs = int(counts.sum())
    arrays = spec.arrays_in(parts, room)
    filled = {name: array[:, :num_envs] for name, array in arrays.items()}
    return Transfer(spec, num_envs, np.repeat(versions, counts), filled)
