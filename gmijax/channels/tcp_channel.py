"""Channels between hosts: one TCP connection for every pair of agent and trainer.

The trainer listens, the agent connects (`tcp_connection.py`). Messages carry a sequence number.
The trainer acknowledges what it has released, which bounds what is on the way. The end of a
connection without a goodbye means that the peer is gone. What a killed agent had not yet put on
the wire is lost, and nothing else.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from gmijax.channels.pipe import Bytes, Message
from gmijax.channels.pipe_format import message_bytes
from gmijax.channels.tcp_connection import Connection
from gmijax.clock import running_s
from gmijax.errors import CollectiveError, GmijaxError, PeerLost, PipeClosed

DATA, GOODBYE, RELEASED = 1, 2, 3

HEADER: Final = struct.Struct("<QQ")
"""The first part of every message: its kind, and a sequence number."""

FAREWELL_S: Final = 5.0
"""How long an agent that closes waits for a trainer that is not there yet, or takes nothing."""


class _Received(NamedTuple):
    kind: int
    sequence: int
    parts: list[Bytes]


class _End:
    """What both ends of a channel have: a connection, and whether the peer has closed its end."""

    def __init__(self, connection: Connection) -> None:
        self.peer = connection.peer
        self._rank = connection.rank
        self._connection = connection
        self._sequence = 0
        self._has_left = False

    def _send_notice(self, kind: int, sequence: int) -> None:
        """Sends a message without parts, if a peer is there that could need it."""
        self._connection.send([HEADER.pack(kind, sequence)])

    def _why_ended(self, operation: str, step: int) -> GmijaxError | None:
        """Why nothing comes any more; None as long as something may."""
        if self._has_left:
            return PipeClosed(self._rank, self.peer, operation)
        is_cut = self._connection.is_cut()
        return PeerLost(self._rank, self.peer, operation, step) if is_cut else None

    def _next(self) -> _Received | None:
        """The next message; None if there is none now."""
        if (found := self._connection.try_receive()) is None:
            return None
        head = found[0].tobytes() if found else b""
        kind, sequence = HEADER.unpack(head) if len(head) == HEADER.size else (0, 0)
        if kind not in (DATA, GOODBYE, RELEASED):
            # Authenticated: only a GMI of this job has the secret.
            raise CollectiveError(
                f"GMI {self._rank}: no message of a channel from GMI {self.peer}"
            )
        received = _Received(kind, sequence, found[1:])
        self._has_left = self._has_left or received.kind == GOODBYE
        return received


class RemoteWriter(_End):
    """The way to trainer `peer`, which listens at `address`; as a `PipeWriter`.

    Of its load only what comes from this agent is known.
    """

    def __init__(
        self,
        address: str,
        rank: int,
        peer: int,
        capacity_bytes: int,
        secret: bytes,
        farewell_s: float = FAREWELL_S,
    ) -> None:
        super().__init__(
            Connection(address, rank, peer, HEADER.size, listens=False, secret=secret)
        )
        self._farewell_s = farewell_s
        self.max_message_bytes = capacity_bytes // 2
        self._capacity_bytes = capacity_bytes
        self._released = self._on_the_way = 0
        self._lengths: deque[int] = deque()
        self._reserved: list[Bytes] = []

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """See `PipeWriter`."""
        self._read_answers()
        if self._has_left:
            raise PipeClosed(self._rank, self.peer, "send")
        length = message_bytes(sizes)
        if length > self.max_message_bytes:
            raise CollectiveError(
                f"GMI {self._rank}: a message of {length} bytes to GMI {self.peer}, "
                f"at most {self.max_message_bytes}"
            )
        if self._on_the_way + length > self._capacity_bytes:
            return None
        # It is sent from this memory later, so it is not used again.
        self._reserved = [np.empty(size, np.uint8) for size in sizes]
        return self._reserved

    def commit(self) -> None:
        """See `PipeWriter`."""
        parts, self._reserved = self._reserved, []
        self._connection.send([HEADER.pack(DATA, self._sequence), *parts])
        self._lengths.append(message_bytes([part.size for part in parts]))
        self._on_the_way += self._lengths[-1]
        self._sequence += 1

    def load_bytes(self) -> int:
        """See `PipeWriter`."""
        self._read_answers()
        return self._on_the_way

    def occupancy(self) -> float:
        """See `PipeWriter`."""
        return self.load_bytes() / self._capacity_bytes

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `PipeWriter`."""
        self._read_answers()  # A goodbye came before the end.
        return self._why_ended(operation, step)

    def close(self) -> None:
        """See `PipeWriter`."""
        if self._connection.is_closed:
            return
        self._send_notice(GOODBYE, self._sequence)
        # An answer to a socket that is closed resets the connection, and what the network has
        # not delivered by then is lost. A trainer that starts more slowly may still come.
        left = deadline_s = math.inf
        while (load := self.load_bytes()) and not self._has_left and not self._connection.is_cut():
            if load < left:
                left, deadline_s = load, running_s() + self._farewell_s
            elif running_s() > deadline_s:
                break
            time.sleep(1e-3)
        self._connection.close()

    def _read_answers(self) -> None:
        while (received := self._next()) is not None:
            while received.kind == RELEASED and self._released < received.sequence:
                self._released += 1
                self._on_the_way -= self._lengths.popleft()


class RemoteReader(_End):
    """The way from agent `peer`, for which the trainer listens at `address`; as a `PipeReader`."""

    def __init__(
        self,
        address: str,
        rank: int,
        peer: int,
        capacity_bytes: int,
        secret: bytes,
    ) -> None:
        longest = capacity_bytes // 2 + HEADER.size
        super().__init__(Connection(address, rank, peer, longest, listens=True, secret=secret))
        self._is_held = False

    def try_get(self) -> Message | None:
        """See `PipeReader`."""
        self.release()
        if (received := self._next()) is None:
            if self._has_left:
                raise PipeClosed(self._rank, self.peer, "receive")
            return None
        if received.sequence != self._sequence:
            raise CollectiveError(
                f"GMI {self._rank}: message {self._sequence} from GMI {self.peer} is lost, "
                f"here is message {received.sequence}"
            )
        if received.kind == GOODBYE:
            return self.try_get()
        self._sequence += 1
        self._is_held = True
        return tuple(received.parts)

    def release(self) -> None:
        """See `PipeReader`."""
        if self._is_held:
            self._is_held = False
            self._send_notice(RELEASED, self._sequence)

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `PipeReader`."""
        return self._why_ended(operation, step)

    def close(self) -> None:
        """See `PipeReader`."""
        if not self._connection.is_closed:
            self._send_notice(GOODBYE, 0)
            self._connection.close()
