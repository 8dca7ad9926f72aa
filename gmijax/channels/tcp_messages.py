"""Messages of several parts on a TCP connection that is not blocking.

Wire format (little-endian): the number of parts, uint32; their lengths in bytes, uint64 each; the
parts.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Generator, Sequence
from itertools import islice
from typing import Any, Final, cast

import numpy as np

from gmijax.channels.pipe_format import Bytes
from gmijax.errors import CollectiveError

_COUNT: Final = np.dtype("<u4")
_LENGTH: Final = np.dtype("<u8")
_VIEWS_AT_ONCE: Final = 64
"""Buffers of one call of the system, which takes 1,024 at most."""


class Outgoing:
    """What is being sent."""

    def __init__(self) -> None:
        self._views: deque[memoryview] = deque()

    @property
    def has_space(self) -> bool:
        """Whether another message would be sent with those that are here."""
        return len(self._views) < _VIEWS_AT_ONCE

    def add(self, parts: Sequence[Any]) -> None:
        """Takes a message from memory that stays as it is."""
        views = [memoryview(part) for part in parts]
        count = np.array([len(views)], _COUNT)
        lengths = np.array([view.nbytes for view in views], _LENGTH)
        self._views.append(memoryview(count.tobytes() + lengths.tobytes()))
        self._views += [view for view in views if view.nbytes]

    def send(self, connection: socket.socket) -> bool:
        """Sends what the connection takes now; whether that was all."""
        views = self._views
        while views:
            try:
                count = connection.sendmsg(islice(views, _VIEWS_AT_ONCE))
            except BlockingIOError:
                return False
            while views and count >= views[0].nbytes:
                count -= views.popleft().nbytes
            if count:
                views[0] = views[0][count:]
        return True


def messages(
    connection: socket.socket, max_bytes: int
) -> Generator[list[Bytes] | None, None, None]:
    """Messages as they come; None each time that the connection has no more for now.

    Args:
      connection: with the other end.
      max_bytes: longest message; one with more parts than so many bytes hold lengths is too long.

    Raises:
      OSError: the connection has ended.
      CollectiveError: the message that follows is longer.
    """
    count = np.empty(1, _COUNT)
    while True:
        yield from _filled(connection, count)
        num_parts = count.item(0)
        if num_parts * _LENGTH.itemsize > max_bytes:
            raise CollectiveError(f"a message of {num_parts} parts")
        lengths = np.empty(num_parts, _LENGTH)
        yield from _filled(connection, lengths)
        # As Python's integers, which do not wrap around.
        if (total := sum(lengths.tolist())) > max_bytes:
            raise CollectiveError(f"a message of {total} bytes, at most {max_bytes}")
        parts = [np.empty(length, np.uint8) for length in lengths.tolist()]
        for part in parts:
            yield from _filled(connection, part)
        yield parts


def _filled(connection: socket.socket, array: np.ndarray) -> Generator[None, None, None]:
    """Fills an array with what comes; yields each time that it must wait."""
    view = memoryview(cast("Any", array.view(np.uint8))) if array.size else memoryview(b"")
    while view:
        try:
            count = connection.recv_into(view)
        except BlockingIOError:
            yield
            continue
        if not count:
            raise ConnectionError("it has hung up")
        view = view[count:]
