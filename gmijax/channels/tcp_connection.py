"""One end of a TCP connection between two processes of a job, with a thread that moves the bytes.

One end listens, for this one peer and until it has connected; the other end tries until it has.
Both prove that they know the job's secret (`gmijax/collectives/nodes/handshake.py`). A connection
that has ended is not made again.
"""

from __future__ import annotations

import math
import os
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import closing, suppress
from itertools import islice
from typing import Any, Final

from gmijax.channels.pipe_format import Bytes
from gmijax.channels.tcp_messages import Outgoing, messages
from gmijax.clock import running_s
from gmijax.collectives.nodes.handshake import Key, accepted, call
from gmijax.errors import CollectiveError, ConfigError

_LINGER_S: Final = 2.0
"""How long an end that closes waits for what it has not yet put on the wire, and for the other."""

_CALL_AGAIN_S: Final = 0.1
_MESSAGES_AT_ONCE: Final = 8
_SHORTEST_SECRET: Final = 16


class Connection:
    """One end of a connection: messages in and out, and whether the other end is there.

    Args:
      address: `host:port`, at which one of the two listens.
      rank: of this process, for messages.
      peer: that of the other one.
      max_message_bytes: a peer that sends a longer one is disconnected.
      listens: whether this is the end that listens.
      secret: of the job.
      newest_only: of messages that wait, at either end, only the last one is kept.

    Raises:
      CollectiveError: an address that cannot be.
      ConfigError: a secret that is too short.
    """

    def __init__(
        self,
        address: str,
        rank: int,
        peer: int,
        max_message_bytes: int,
        *,
        listens: bool,
        secret: bytes,
        newest_only: bool = False,
    ) -> None:
        if len(secret) < _SHORTEST_SECRET:
            raise ConfigError(
                f"a secret of {len(secret)} bytes: TCP needs {_SHORTEST_SECRET} or more"
            )
        self.rank, self.peer = rank, peer
        self.is_closed = False
        self._max_message_bytes = max_message_bytes
        most = 1 if newest_only else None
        self._incoming: deque[list[Bytes]] = deque(maxlen=most)
        self._outgoing: deque[Sequence[Any]] = deque(maxlen=most)
        self._error: CollectiveError | None = None
        self._was_up = self._has_ended = False
        self._key = Key(secret, f"GMI {rank if listens else peer}")
        try:
            host, _, port = address.rpartition(":")
            self._address = host, int(port)
            self._listener = _listening(self._address) if listens else None
        except (OSError, ValueError, OverflowError) as error:
            raise CollectiveError(
                f"GMI {rank}: no connection with GMI {peer} at {address} ({error})"
            ) from None
        self._work, self._work_lock = os.eventfd(0, os.EFD_NONBLOCK), threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"tcp-{peer}", daemon=True)
        self._thread.start()

    def send(self, parts: Sequence[Any]) -> None:
        """Sends a message from memory that stays as it is, unless the other end has left."""
        if not (self.is_closed or self._has_ended):
            self._outgoing.append(parts)
            self._wake()

    def try_receive(self) -> list[Bytes] | None:
        """The next message; None if there is none.

        Raises:
          CollectiveError: the other end has sent what is none.
        """
        if self.is_closed:
            return None
        error = self._error  # Before the look: what came before the error is still given out.
        with suppress(IndexError):
            return self._incoming.popleft()
        if error is not None:
            raise error
        return None

    def is_cut(self) -> bool:
        """Whether there was a connection and is none now, and all has been received."""
        return self._was_up and self._has_ended and not self._incoming

    def close(self) -> None:
        """Leaves at once, but for what is not on the wire. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            self._wake()
            if self._was_up:
                self._thread.join(2 * _LINGER_S)

    def _wake(self) -> None:
        with self._work_lock:
            if not self._has_ended:
                os.eventfd_write(self._work, 1)

    def _run(self) -> None:
        try:
            connection = self._accept() if self._listener else self._connect()
            if connection is not None:
                with connection:
                    self._was_up = True
                    self._exchange(connection)
        except OSError:
            pass  # The other end is gone.
        except CollectiveError as error:
            self._error = CollectiveError(f"GMI {self.rank}: GMI {self.peer} sends {error}")
        finally:
            with self._work_lock:
                self._has_ended = True
                os.close(self._work)

    def _time_left(self) -> float:
        return 0.0 if self.is_closed else math.inf

    def _accept(self) -> socket.socket | None:
        """The connection of the peer, with the listener closed; None if it did not connect."""
        assert self._listener is not None
        with self._listener, closing(accepted(self._listener, self._key, self._time_left)) as all_:
            for connection, caller in all_:
                if caller == (self.peer, self.rank):
                    return connection
                connection.close()
        return None

    def _connect(self) -> socket.socket | None:
        """The connection with the peer, once it listens; None if it did not before the end."""
        while not self.is_closed:
            with suppress(OSError):
                return call(self._address, self._key, (self.rank, self.peer), self._time_left)
            time.sleep(_CALL_AGAIN_S)
        return None

    def _exchange(self, connection: socket.socket) -> None:
        """Sends and receives until one of the two ends leaves."""
        outgoing, incoming = Outgoing(), messages(connection, self._max_message_bytes)
        with selectors.DefaultSelector() as selector:
            selector.register(connection, selectors.EVENT_READ)
            selector.register(self._work, selectors.EVENT_READ)
            while not self.is_closed:
                has_more = not self._send(connection, outgoing)
                wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if has_more else 0)
                selector.modify(connection, wanted)
                for key, events in selector.select():
                    if key.fileobj == self._work:
                        os.eventfd_read(self._work)
                    elif events & selectors.EVENT_READ:
                        for found in islice(incoming, _MESSAGES_AT_ONCE):
                            if found is None:  # The rest of it is still to come.
                                break
                            self._incoming.append(found)
        self._leave(connection, outgoing)

    def _send(self, connection: socket.socket, outgoing: Outgoing) -> bool:
        """Sends what the connection takes now; whether that was all."""
        try:
            while outgoing.send(connection):
                if not self._outgoing:
                    return True
                while self._outgoing and outgoing.has_space:
                    outgoing.add(self._outgoing.popleft())
        except ConnectionError:
            return True  # The other end takes nothing more, but may have sent something before.
        return False

    def _leave(self, connection: socket.socket, outgoing: Outgoing) -> None:
        """Sends what is left, and reads until the other end has left too.

        Otherwise the other end would lose what it has not read yet.
        """
        until_s = running_s() + _LINGER_S
        connection.settimeout(_LINGER_S)
        self._send(connection, outgoing)
        connection.shutdown(socket.SHUT_WR)
        while running_s() < until_s and connection.recv(2**16):
            pass


def _listening(address: tuple[str, int]) -> socket.socket:
    """A listening socket, which may share its port with the process that reserved it."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except BaseException:
        listener.close()
        raise
    return listener
