"""What trainers and agents tell each other, as notes that nobody ever waits for.

Note 0: orders of the leading trainer. Note 1: the newest weights, with the policy's version as
tag. Then one note per agent: what it has done so far. Experience travels elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

_NO_CHECKPOINT = -1


class Posted(Protocol):
    """The newest value of a note: how often it was published, a number, and its bytes."""

    @property
    def count(self) -> int: ...  # noqa: D102

    @property
    def tag(self) -> int: ...  # noqa: D102

    @property
    def values(self) -> npt.NDArray[np.uint8]: ...  # noqa: D102


class Note(Protocol):
    """One place on the board: one writer, any number of readers."""

    def publish(self, values: npt.NDArray, tag: int = 0) -> None:
        """Replaces the value; never waits."""
        ...

    def read(self, after: int = 0) -> Posted | None:
        """The newest value if it was published after the `after`-th, else None; never waits."""
        ...


class Orders(NamedTuple):
    """What the leading trainer wants of all agents.

    Attributes:
      checkpoint: environment steps of the checkpoint to which every agent is to add its
        environments, None for none.
      is_ending: whether agents are to end when they have done so.
    """

    checkpoint: int | None
    is_ending: bool


class Report(NamedTuple):
    """What an agent has done since its start.

    Attributes:
      checkpoint: environment steps of the latest checkpoint that it has added to, or None.
      env_steps: environment steps acted upon: predictions.
      bytes_sent: of experience.
      dropped: pieces of experience that were dropped because there was no room.
      send_s: seconds spent on sending, with waits for room.
      wait_s: those of them in which it waited for room and had nothing to compute.
      occupancy: fraction of the room for experience that was full, after the last send.
      stats: [M] sums over all its unrolls, see `gmijax.learning.unroll.Counts`.
    """

    checkpoint: int | None
    env_steps: float
    bytes_sent: float
    dropped: float
    send_s: float
    wait_s: float
    occupancy: float
    stats: npt.NDArray[np.float64]


class Board(NamedTuple):
    """All notes of a job, see the module."""

    orders: Note
    weights: Note
    reports: Sequence[Note]


def note_sizes(num_weights: int, num_stats: int, num_agents: int) -> list[int]:
    """Bytes of every note, in the order of `board_of`."""
    report = 8 * (len(Report._fields) - 1 + num_stats)
    return [8 * len(Orders._fields), 4 * num_weights, *[report] * num_agents]


def board_of(notes: Sequence[Note]) -> Board:
    """The board from its notes."""
    return Board(notes[0], notes[1], tuple(notes[2:]))


def pack_orders(orders: Orders) -> npt.NDArray[np.int64]:
    """As numbers for the note."""
    return np.array([_number(orders.checkpoint), orders.is_ending], np.int64)


def unpack_orders(posted: Posted) -> Orders:
    """Inverts `pack_orders`."""
    checkpoint, is_ending = posted.values.view(np.int64)
    return Orders(_optional(checkpoint), bool(is_ending))


def pack_report(report: Report) -> npt.NDArray[np.float64]:
    """As numbers for the note; environment steps are exact up to 2^53."""
    head = [_number(report.checkpoint), *report[1:-1]]
    return np.concatenate([np.array(head, np.float64), report.stats])


def unpack_report(posted: Posted) -> Report:
    """Inverts `pack_report`."""
    numbers = posted.values.view(np.float64)
    head = len(Report._fields) - 1
    first, *rest = (float(x) for x in numbers[:head])
    return Report(_optional(first), *rest, stats=numbers[head:])


def _number(checkpoint: int | None) -> int:
    return _NO_CHECKPOINT if checkpoint is None else checkpoint


def _optional(number: float) -> int | None:
    return None if number == _NO_CHECKPOINT else int(number)
