"""Channels between hosts: one TCP connection for every pair of agent and trainer, by pyzmq.

The trainer listens, the agent connects. Messages carry a sequence number; all is encrypted and
authenticated (`connection.py`), so that no byte of it can change on the way. The trainer
acknowledges what it has released, which bounds what is on the way. The end of a connection without
a goodbye means that the peer is gone; so do ten seconds without ZeroMQ's own heartbeats. What a
killed agent had not yet put on the wire is lost, and nothing else. What is no message of a channel
is dropped and counted.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from gmijax.collectives.channel.connection import Connection
from gmijax.collectives.messages.pipe import Bytes, Message
from gmijax.collectives.messages.pipe_format import message_bytes
from gmijax.errors import CollectiveError, GmijaxError, PeerLost, PipeClosed

MAGIC: Final = 0x5A494D47  # "GMIZ" in memory on a little-endian machine
DATA, GOODBYE, RELEASED = 1, 2, 3

_HEADER: Final = struct.Struct("<IIQq")
"""magic, kind, sequence, tag."""

MAX_PART_BYTES: Final = 2**30
"""Longest part of a message: who sends a longer one is cut off."""

_MAX_ANSWER_BYTES: Final = 4096
"""Longest part that an agent gets: a header, and what ZeroMQ's handshake takes."""

_FAREWELL_S: Final = 5.0
"""How long an agent that closes waits for its trainer to take what is on the way."""


class RemoteWriter:
    """The way to trainer `peer`, which listens at `address`; a `ChannelWriter`.

    Of its load only what comes from this agent is known.
    """

    def __init__(self, address: str, rank: int, peer: int, capacity_bytes: int) -> None:
        self.peer = peer
        self.max_message_bytes = min(capacity_bytes // 2, MAX_PART_BYTES)
        self.num_dropped = 0
        self._capacity_bytes = capacity_bytes
        self._connection = Connection(address, rank, peer, _MAX_ANSWER_BYTES, listens=False)
        self._sequence = self._released = 0
        self._lengths: deque[int] = deque()
        self._on_the_way = 0
        self._has_left = False
        self._reserved: list[Bytes] = []

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """See `ChannelWriter`."""
        self._read_answers()
        if self._has_left:
            raise PipeClosed(self._connection.rank, self.peer, "send")
        length = message_bytes(sizes)
        if length > self.max_message_bytes:
            raise CollectiveError(
                f"rank {self._connection.rank}: a message of {length} bytes to rank {self.peer}, "
                f"at most {self.max_message_bytes}"
            )
        if self._on_the_way + length > self._capacity_bytes:
            return None
        # ZeroMQ sends from this memory later, so it is not used again.
        self._reserved = [np.empty(size, np.uint8) for size in sizes]
        return self._reserved

    def commit(self, *, tag: int = 0) -> None:
        """See `ChannelWriter`."""
        parts, self._reserved = self._reserved, []
        head = _HEADER.pack(MAGIC, DATA, self._sequence, tag)
        self._connection.send([head, *parts])
        length = message_bytes([part.size for part in parts])
        self._lengths.append(length)
        self._on_the_way += length
        self._sequence += 1

    def load_bytes(self) -> int:
        """See `ChannelWriter`."""
        self._read_answers()
        return self._on_the_way

    def occupancy(self) -> float:
        """See `ChannelWriter`."""
        return self.load_bytes() / self._capacity_bytes

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `ChannelWriter`."""
        is_cut = self._connection.is_cut()
        self._read_answers()  # A goodbye came before the end.
        if self._has_left:
            return PipeClosed(self._connection.rank, self.peer, operation)
        return PeerLost(self._connection.rank, self.peer, operation, step) if is_cut else None

    def close(self) -> None:
        """See `ChannelWriter`."""
        if not self._connection.is_closed:
            _tell(self._connection, GOODBYE, self._sequence)
            self._wait_until_taken()
            self._connection.close()

    def _wait_until_taken(self) -> None:
        # An answer to a socket that is closed resets the connection, and what the network has
        # not delivered by then is lost.
        deadline_s = time.monotonic() + _FAREWELL_S
        while self.load_bytes() and not self._has_left and self._connection.is_up():
            if time.monotonic() > deadline_s:
                break
            time.sleep(1e-3)

    def _read_answers(self) -> None:
        while (frames := self._connection.try_receive()) is not None:
            if (header := _unpack(frames)) is None:
                self.num_dropped += 1
                continue
            _, kind, sequence, *_ = header
            if kind == GOODBYE:
                self._has_left = True
            while kind == RELEASED and self._released < sequence:
                self._released += 1
                self._on_the_way -= self._lengths.popleft()


class RemoteReader:
    """The way from agent `peer`, for which the trainer listens at `address`; a `ChannelReader`.

    Attributes:
      num_dropped: what came and was no message of a channel.
    """

    def __init__(self, address: str, rank: int, peer: int) -> None:
        self.peer = peer
        self.num_dropped = 0
        longest = MAX_PART_BYTES + _MAX_ANSWER_BYTES
        self._connection = Connection(address, rank, peer, longest, listens=True)
        self._sequence = 0
        self._is_held = self._has_left = False
        self._is_cut = self._is_empty = False

    def try_get(self) -> Message | None:
        """See `ChannelReader`."""
        self.release()
        frames, header = self._next_of_channel()
        if header is None:
            self._is_empty = True
            if self._has_left:
                raise PipeClosed(self._connection.rank, self.peer, "receive")
            return None
        _, kind, sequence, tag = header
        if sequence != self._sequence:
            raise CollectiveError(
                f"rank {self._connection.rank}: message {self._sequence} from rank {self.peer} "
                f"is lost, here is message {sequence}"
            )
        if kind == GOODBYE:
            self._has_left = True
            return self.try_get()
        self._sequence += 1
        self._is_held = True
        return Message(tag, tuple(np.frombuffer(frame, np.uint8) for frame in frames[1:]))

    def release(self) -> None:
        """See `ChannelReader`."""
        if self._is_held:
            self._is_held = False
            _tell(self._connection, RELEASED, self._sequence)

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `ChannelReader`."""
        if self._has_left:
            return PipeClosed(self._connection.rank, self.peer, operation)
        is_cut, was_cut = self._connection.is_cut(), self._is_cut
        self._is_cut = is_cut
        if not (was_cut and is_cut):
            # Not before all has been read that came until the end, perhaps a goodbye.
            self._is_empty = False
        if is_cut and self._is_empty:
            return PeerLost(self._connection.rank, self.peer, operation, step)
        return None

    def close(self) -> None:
        """See `ChannelReader`."""
        if not self._connection.is_closed:
            _tell(self._connection, GOODBYE, 0)
            self._connection.close()

    def _next_of_channel(self) -> tuple[Sequence[Any], tuple[int, ...] | None]:
        """The next message and its header; None for that if there is none."""
        while (frames := self._connection.try_receive()) is not None:
            if (header := _unpack(frames)) is not None:
                return frames, header
            self.num_dropped += 1
        return (), None


def _tell(connection: Connection, kind: int, sequence: int) -> None:
    """Sends a message without parts, if there is somebody who could want it."""
    connection.try_send([_HEADER.pack(MAGIC, kind, sequence, 0)])


def _unpack(frames: Sequence[Any]) -> tuple[int, ...] | None:
    """The header of a message, None if it is none of a channel."""
    if len(frames[0]) != _HEADER.size:
        return None
    header = _HEADER.unpack(frames[0])
    return header if header[0] == MAGIC and header[1] in (DATA, GOODBYE, RELEASED) else None
