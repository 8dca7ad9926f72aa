"""Compressor: joins the pieces of every channel until a transfer is large enough (section 4.2).

A transfer is one message. Its parts are the spec, a table, and one array a channel into which
the pieces are written side by side along the axis of environments. The memory is the migrator's,
so that a piece is copied once, from the agent's arrays to where the trainer reads it.

All channels of a piece travel in one transfer: a trainer can use none without the others, and a
process that is killed leaves the whole of a transfer or nothing of it.

The table is [2 + capacity] int64: the capacity in environments, how many there are, and the policy
version of each.
"""

from __future__ import annotations

import statistics
import time

import numpy as np
import numpy.typing as npt

from gmijax.channels.experience import VERSION_BYTES, Array, Rollouts, Spec
from gmijax.channels.migrator import ChannelWriter, Migrator
from gmijax.channels.pipe import Message

TABLE_HEAD = 2
"""Numbers of the table before the versions."""

START_BYTES = 64 * 1024
SAMPLES = 9
WORTH_IT = 0.95
"""A size is better if it takes less than this part of the time per byte."""


class TransferSize:
    """Doubles `num_bytes` as long as a byte gets cheaper, then keeps the best.

    The price of a transfer is fixed plus so much a byte, so that there is no use in continuing
    once it has stopped falling; larger transfers only make experience older.
    """

    def __init__(self, max_bytes: int) -> None:
        self.num_bytes = min(START_BYTES, max_bytes)
        self.is_tuned = False
        self._max_bytes = max_bytes
        self._samples: list[float] = []
        self._best: tuple[float, int] | None = None

    def record(self, num_bytes: int, seconds: float) -> None:
        """Records the cost of one transfer, without the time it waited for space."""
        if self.is_tuned or not num_bytes:
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
        self.num_bytes, self.is_tuned = self._best[1], True


class Compressor:
    """Fills transfers with pieces, one transfer at a time; a `MessageEncoder`.

    `max_transfer_bytes` bounds the sum of all channels and versions.
    """

    def __init__(self, migrator: Migrator, size: TransferSize, max_transfer_bytes: int) -> None:
        self._migrator = migrator
        self._size = size
        self._max_transfer_bytes = max_transfer_bytes
        # The transfer that is being filled: the way it goes (None: there is none), its memory.
        self._writer: ChannelWriter | None = None
        self._spec = Spec(())
        self._table: npt.NDArray[np.int64] = np.zeros(TABLE_HEAD, np.int64)
        self._arrays: dict[str, Array] = {}
        self._spent_s = 0.0

    def try_add(self, piece: Rollouts) -> bool:
        """Puts `piece` into a transfer, if there is space; hands the transfer over when full."""
        if self._writer is not None and not self._takes(piece):
            self.flush()
        if self._writer is None and not self._begin(piece):
            return False
        started_s = time.perf_counter()
        capacity, low = self._table[:TABLE_HEAD].tolist()
        high = low + piece.num_envs
        for name, array in piece.experience.items():
            self._arrays[name][:, low:high] = array
        self._table[TABLE_HEAD + low : TABLE_HEAD + high] = piece.versions
        self._table[1] = high
        self._spent_s += time.perf_counter() - started_s
        if high == capacity:
            self.flush()
        return True

    def flush(self) -> None:
        """Hands over what there is."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        num_bytes = sum(self._spec.sizes(self._table.item(1)))
        started_s = time.perf_counter()
        writer.commit()
        self._size.record(num_bytes, self._spent_s + time.perf_counter() - started_s)

    def _takes(self, piece: Rollouts) -> bool:
        capacity, filled = self._table[:TABLE_HEAD].tolist()
        return piece.spec == self._spec and filled + piece.num_envs <= capacity

    def _begin(self, piece: Rollouts) -> bool:
        """Opens a transfer for pieces of this size; False if no trainer has space."""
        piece_bytes = piece.num_bytes + VERSION_BYTES * piece.num_envs
        target_bytes = min(self._size.num_bytes, self._max_transfer_bytes)
        capacity = piece.num_envs * max(1, target_bytes // piece_bytes)
        head = piece.spec.encode()
        table_bytes = 8 * TABLE_HEAD + VERSION_BYTES * capacity
        sizes = [head.size, table_bytes, *piece.spec.sizes(capacity)]
        opened = self._migrator.try_open(sizes)
        if opened is None:
            return False
        self._writer, views = opened
        views[0][:] = head
        self._table = views[1].view(np.int64)
        self._table[:] = 0
        self._table[0] = capacity
        self._spec, self._arrays = piece.spec, piece.spec.arrays_in(views[2:], capacity)
        self._spent_s = 0.0
        return True


def read_transfer(message: Message, agent: int) -> Rollouts:
    """What a `Compressor` of this agent made; a `Decode`. Its arrays are views of the message."""
    head, table, *parts = message
    spec, table = Spec.decode(head), table.view(np.int64)
    capacity, filled = table[:TABLE_HEAD].tolist()
    arrays = spec.arrays_in(parts, capacity)
    return Rollouts(
        spec,
        {name: array[:, :filled] for name, array in arrays.items()},
        table[TABLE_HEAD : TABLE_HEAD + filled].copy(),
        np.full(filled, agent, np.int64),
    )
