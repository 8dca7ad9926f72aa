"""One end of a TCP connection between two processes, by pyzmq, for those who share a secret.

ZeroMQ's CURVE encrypts and authenticates. Whoever listens has a pair of keys that follows from the
secret, and its public half is told to nobody: without it no handshake succeeds. The GMIs of a job
on several nodes are given the job's.
"""

from __future__ import annotations

import contextlib
import hashlib
import socket
from collections.abc import Sequence
from typing import Any, Final

from gmijax.errors import CollectiveError, ConfigError

try:
    import zmq
    from zmq.utils import z85
    from zmq.utils.monitor import recv_monitor_message
except ImportError:
    raise ConfigError(
        "channels between nodes: pyzmq is not installed; the package extra ray brings it"
    ) from None

_LINGER_MS: Final = 2000
"""How long an end waits for what it has not yet put on the wire, at its close or exit."""

_SHORTEST_SECRET: Final = 16

_OPTIONS: Final = {
    zmq.SNDHWM: 0,  # Acknowledgements bound what waits, not a number of messages.
    zmq.RCVHWM: 0,
    zmq.LINGER: _LINGER_MS,
    zmq.HEARTBEAT_IVL: 2000,
    zmq.HEARTBEAT_TIMEOUT: 10000,
}

_WATCHED: Final = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_CONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_DISCONNECTED
)


class Connection:
    """One end of a connection: frames in and out, and whether the other end is there.

    Args:
      address: `host:port`, at which one of the two listens.
      rank: of this process, for messages.
      peer: that of the other one.
      max_frame_bytes: who sends a longer part of a message is cut off.
      listens: whether this is the end that listens.
      secret: of the job.
      newest_only: of messages that wait, at either end, the last one takes the place of all
        others; they have one part.

    Raises:
      CollectiveError: an address that cannot be.
      ConfigError: a secret that is too short.
    """

    def __init__(
        self,
        address: str,
        rank: int,
        peer: int,
        max_frame_bytes: int,
        *,
        listens: bool,
        secret: bytes,
        newest_only: bool = False,
    ) -> None:
        self.rank, self.peer = rank, peer
        self.is_closed = False
        self._proved: set[int] = set()
        self._strangers: set[int] = set()
        self._handshakes = 0
        self._was_up = False
        server_key = _server_key(secret)
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        for option, value in _OPTIONS.items():
            self._socket.setsockopt(option, value)
        self._socket.setsockopt(zmq.MAXMSGSIZE, max_frame_bytes)
        self._socket.setsockopt(zmq.CONFLATE, newest_only)
        self._monitor = self._socket.get_monitor_socket(_WATCHED)
        try:
            if listens:
                self._socket.setsockopt(zmq.CURVE_SERVER, 1)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, server_key)
                self._socket.setsockopt(zmq.USE_FD, _listening(address))
                self._socket.bind(f"tcp://{address}")
            else:
                own_public, own_secret = zmq.curve_keypair()
                self._socket.setsockopt(zmq.CURVE_SERVERKEY, zmq.curve_public(server_key))
                self._socket.setsockopt(zmq.CURVE_PUBLICKEY, own_public)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, own_secret)
                self._socket.connect(f"tcp://{address}")
        except (OSError, ValueError, OverflowError, zmq.ZMQError) as error:
            self.close()
            raise CollectiveError(
                f"GMI {rank}: no connection with GMI {peer} at {address} ({error})"
            ) from None

    def send(self, frames: Sequence[Any]) -> None:
        """Sends a message from memory that stays as it is."""
        self._socket.send_multipart(frames, flags=zmq.NOBLOCK, copy=False)

    def try_send(self, frames: Sequence[Any]) -> None:
        """Sends a message, if there is somebody who could want it."""
        with contextlib.suppress(zmq.Again):
            self.send(frames)

    def try_receive(self) -> list[Any] | None:
        """The next message as buffers, without a copy; None if there is none."""
        if self.is_closed:
            return None
        try:
            return [f.buffer for f in self._socket.recv_multipart(zmq.NOBLOCK, copy=False)]
        except zmq.Again:
            return None

    def is_up(self) -> bool:
        """Whether there is a connection."""
        return not self.is_cut() and self._was_up

    def is_cut(self) -> bool:
        """Whether there was a connection and is none now."""
        while not self.is_closed and self._monitor.poll(0):
            message = recv_monitor_message(self._monitor)
            self._note(message["event"], message["value"])
        return self._was_up and not (self._proved or self._handshakes)

    def _note(self, event: int, descriptor: int) -> None:
        """Tells connections of the peer from those of strangers, who end without a handshake.

        ZeroMQ does not say whose handshake succeeded: it shows when the others have ended, which
        ZeroMQ sees to within half a minute.
        """
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._handshakes += 1
            self._was_up = True
        elif event == zmq.EVENT_DISCONNECTED:
            self._proved.discard(descriptor)
            self._strangers.discard(descriptor)
        else:
            self._strangers.add(descriptor)
        if self._handshakes and len(self._strangers) <= self._handshakes:
            self._proved |= self._strangers
            self._strangers, self._handshakes = set(), 0

    def close(self) -> None:
        """Leaves at once, but for what is not on the wire. Idempotent."""
        if not self.is_closed:
            linger_ms = 0 if self.is_cut() else _LINGER_MS
            self.is_closed = True
            self._socket.disable_monitor()
            self._monitor.close()
            self._socket.close(linger_ms)
            self._context.term()


def _server_key(secret: bytes) -> bytes:
    """The secret key of whoever listens, as ZeroMQ writes keys."""
    if len(secret) < _SHORTEST_SECRET:
        raise ConfigError(f"a secret of {len(secret)} bytes: TCP needs {_SHORTEST_SECRET} or more")
    return z85.encode(hashlib.sha256(b"gmijax channel " + secret).digest())


def _listening(address: str) -> int:
    """A listening socket, which may share its port with who reserved it."""
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, int(port)))
        listener.listen()
        return listener.detach()
