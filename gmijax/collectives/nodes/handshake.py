"""How two processes of a job prove to each other over TCP that both know the job's token.

A listener is open to the whole network, so unauthenticated clients must cost it little: all are
read concurrently, each has two seconds in all, and beyond a limit the oldest is disconnected. A
caller that is disconnected connects again. What is sent after the handshake is neither encrypted
nor signed.

| step | caller sends | listener sends |
|---|---|---|
| 1 | 32 random bytes | 32 random bytes |
| 2 | its identity (8 bytes), and an HMAC | |
| 3 | | an HMAC, once that of the caller is right |

The HMAC (SHA-256, under the token) covers the role (the bytes `calls` or `hears`), the identity of
the caller, both random numbers, and the name of the listener: what was sent once, elsewhere or by
the other end proves nothing.
"""

from __future__ import annotations

import hmac
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from typing import Final, NamedTuple, TypeAlias

from gmijax.clock import running_s
from gmijax.collectives.waits import LIVENESS_PERIOD_S

PROOF_TIMEOUT_S: Final = 2.0
"""How long a caller has from its connection to its proof."""

MAX_UNAUTHENTICATED: Final = 16
"""Unauthenticated clients that a listener holds at a time; each takes a descriptor."""

_CONNECT_S: Final = 1.0  # No longer, or the clock stands still.
_RETRY_S: Final = 0.1
_PAUSE_S: Final = 0.01
_ACCEPTED_AT_ONCE: Final = 4
_CALLS: Final = b"calls"
_HEARS: Final = b"hears"  # The listener's; both are part of the protocol.
_CALLER: Final = struct.Struct("<II")
_NONCE_BYTES = _PROOF_BYTES = 32
_CALL_BYTES: Final = _NONCE_BYTES + _CALLER.size + _PROOF_BYTES
_KEEP_ALIVE: Final = {socket.TCP_KEEPIDLE: 10, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 6}
"""A machine that is gone is noticed after some forty seconds, if nothing is being sent to it."""

Caller: TypeAlias = tuple[int, int]
"""Identity of a caller: two numbers whose meaning is up to the user of this module."""

TimeLeft: TypeAlias = Callable[[], float]
"""Seconds that may still be waited; called five times a second."""


class Unreachable(ConnectionError):
    """There is no route to the address, or no process listens there."""


class Key(NamedTuple):
    """What both ends must know.

    Attributes:
      token: the secret of the job.
      listener: which of the job's listeners it is.
    """

    token: bytes
    listener: str

    def proof(self, role: bytes, caller: bytes, nonces: bytes) -> bytes:
        """Proves that the end with this role knows the key."""
        message = role + caller + nonces + self.listener.encode()
        return hmac.digest(self.token, message, "sha256")


def call(address: tuple[str, int], key: Key, caller: Caller, time_left: TimeLeft) -> socket.socket:
    """Connects with a listener that knows the key.

    Raises:
      Unreachable: there is no connection.
      OSError: there is one, and the other end has not proved that it knows the key.
    """
    while True:
        connection = _connected(address, time_left)
        try:
            _prove(connection, key, _CALLER.pack(*caller), time_left)
            return _ready(connection)
        except ConnectionError:
            # The listener may have too many unauthenticated clients.
            connection.close()
            if time_left() <= _RETRY_S:
                raise
            time.sleep(_RETRY_S)
        except BaseException:
            connection.close()
            raise


def accepted(
    listener: socket.socket, key: Key, time_left: TimeLeft
) -> Generator[tuple[socket.socket, Caller], None, None]:
    """Connections with callers that know the key, as they come, until the time is up."""
    clients = _UnauthenticatedClients(listener, key)
    try:
        while (left_s := time_left()) > 0:
            yield from clients.poll(min(left_s, LIVENESS_PERIOD_S))
    finally:
        clients.close()


class _UnauthenticatedClients:
    """Callers that have not proved anything yet, in the order in which they connected."""

    def __init__(self, listener: socket.socket, key: Key) -> None:
        self._listener, self._key = listener, key
        self._clients: dict[socket.socket, _UnauthenticatedClient] = {}
        self._selector = selectors.DefaultSelector()
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)

    def poll(self, timeout_s: float) -> Iterator[tuple[socket.socket, Caller]]:
        """Reads what clients have sent, drops those that are late, and accepts new ones."""
        readable = {key.fileobj for key, _ in self._selector.select(timeout_s)}
        for connection in [client for client in self._clients if client in readable]:
            try:
                caller = self._clients[connection].receive()
            except OSError:
                self._drop(connection)
                continue
            if caller is not None:
                self._drop(connection, closes=False)
                yield _ready(connection), caller
        now_s = running_s()
        for connection in [c for c, client in self._clients.items() if now_s > client.until_s]:
            self._drop(connection)
        if self._listener in readable:
            self._accept()

    def close(self) -> None:
        """Disconnects all of them; the listener stays open."""
        for connection in list(self._clients):
            self._drop(connection)
        self._selector.close()

    def _accept(self) -> None:
        # Not all at once: those that are answering are read in between.
        for _ in range(_ACCEPTED_AT_ONCE):
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError:  # Out of descriptors, or it has gone again.
                self._drop_oldest()
                time.sleep(_PAUSE_S)
                return
            connection.setblocking(False)
            self._clients[connection] = _UnauthenticatedClient(connection, self._key)
            self._selector.register(connection, selectors.EVENT_READ)
            if len(self._clients) > MAX_UNAUTHENTICATED:
                self._drop_oldest()

    def _drop_oldest(self) -> None:
        if self._clients:
            self._drop(next(iter(self._clients)))

    def _drop(self, connection: socket.socket, *, closes: bool = True) -> None:
        self._selector.unregister(connection)
        del self._clients[connection]
        if closes:
            connection.close()


class _UnauthenticatedClient:
    """A caller that has connected and not proved anything yet."""

    def __init__(self, connection: socket.socket, key: Key) -> None:
        self.until_s = running_s() + PROOF_TIMEOUT_S
        self._connection, self._key = connection, key
        self._nonce = os.urandom(_NONCE_BYTES)
        self._received = b""
        self._has_nonce = False

    def receive(self) -> Caller | None:
        """The caller, once it is proved; None before. Raises OSError if it never will be."""
        if not self._has_nonce:
            self._connection.sendall(self._nonce)
            self._has_nonce = True
        try:
            part = self._connection.recv(_CALL_BYTES - len(self._received))
        except BlockingIOError:
            return None
        if not part:
            raise ConnectionError("it has hung up")
        self._received += part
        if len(self._received) < _CALL_BYTES:
            return None
        nonce, rest = self._received[:_NONCE_BYTES], self._received[_NONCE_BYTES:]
        caller, proof = rest[: _CALLER.size], rest[_CALLER.size :]
        nonces = nonce + self._nonce
        if not hmac.compare_digest(proof, self._key.proof(_CALLS, caller, nonces)):
            raise ConnectionError("it is not of this job")
        self._connection.sendall(self._key.proof(_HEARS, caller, nonces))
        return _CALLER.unpack(caller)


def _connected(address: tuple[str, int], time_left: TimeLeft) -> socket.socket:
    """A connection with the process that listens there."""
    while True:
        left_s = max(time_left(), _PAUSE_S)
        try:
            return socket.create_connection(address, min(left_s, _CONNECT_S))
        except TimeoutError:
            # Other clients may have filled the backlog of the listener.
            if time_left() <= 0:
                raise Unreachable("timed out") from None
        except OSError as error:
            raise Unreachable(error.strerror or str(error)) from None


def _prove(connection: socket.socket, key: Key, caller: bytes, time_left: TimeLeft) -> None:
    """Proves to a listener that this process knows the key, and has it prove the same."""
    nonce = os.urandom(_NONCE_BYTES)
    connection.sendall(nonce)
    nonces = nonce + _read(connection, _NONCE_BYTES, time_left)
    connection.sendall(caller + key.proof(_CALLS, caller, nonces))
    expected = key.proof(_HEARS, caller, nonces)
    if not hmac.compare_digest(_read(connection, len(expected), time_left), expected):
        raise ConnectionError("it is not of this job")


def _read(connection: socket.socket, num_bytes: int, time_left: TimeLeft) -> bytes:
    received = b""
    while len(received) < num_bytes:
        if (left_s := time_left()) <= 0:
            raise TimeoutError("it does not answer")
        connection.settimeout(min(left_s, LIVENESS_PERIOD_S))
        with suppress(TimeoutError):
            part = connection.recv(num_bytes - len(received))
            if not part:
                raise ConnectionError("it has hung up")
            received += part
    return received


def _ready(connection: socket.socket) -> socket.socket:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEP_ALIVE.items():
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
    connection.setblocking(False)
    return connection
