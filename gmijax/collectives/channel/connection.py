"""One end of a TCP connection between two processes, by pyzmq."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from typing import Any, Final

from gmijax.errors import CollectiveError, ConfigError

try:
    import zmq
    from zmq.utils.monitor import recv_monitor_message
except ImportError:
    raise ConfigError(
        "channel.transport=zmq: pyzmq is not installed; the package extra zmq brings it"
    ) from None

_LINGER_MS: Final = 2000
"""How long an end waits for what it has not yet put on the wire, at its close or exit."""

_OPTIONS: Final = {
    zmq.SNDHWM: 0,  # Acknowledgements bound what waits, not a number of messages.
    zmq.RCVHWM: 0,
    zmq.LINGER: _LINGER_MS,
    zmq.HEARTBEAT_IVL: 2000,
    zmq.HEARTBEAT_TIMEOUT: 10000,
}

_HANDSHAKE_FAILED: Final = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)


class Connection:
    """One end of a connection: frames in and out, and whether the other end is there."""

    def __init__(self, address: str, rank: int, peer: int, *, listens: bool) -> None:
        self.rank, self.peer = rank, peer
        self.is_closed = False
        self._connections = self._failures = 0
        self._was_up = False
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        for option, value in _OPTIONS.items():
            self._socket.setsockopt(option, value)
        self._monitor = self._socket.get_monitor_socket(
            zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED | _HANDSHAKE_FAILED
        )
        try:
            if listens:
                self._socket.setsockopt(zmq.USE_FD, _listening(address))
                self._socket.bind(f"tcp://{address}")
            else:
                self._socket.connect(f"tcp://{address}")
        except (OSError, ValueError, OverflowError, zmq.ZMQError) as error:
            self.close()
            raise CollectiveError(
                f"rank {rank}: no connection with rank {peer} at {address} ({error})"
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
            event = recv_monitor_message(self._monitor)["event"]
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._connections += 1
                self._was_up = True
            elif event & _HANDSHAKE_FAILED:
                self._failures += 1
            elif self._failures:  # The end of a connection that was none, of whomever.
                self._failures -= 1
            else:
                self._connections = max(0, self._connections - 1)
        return self._was_up and not self._connections

    def close(self) -> None:
        """Leaves at once, but for what is not on the wire; calling it twice is fine."""
        if not self.is_closed:
            linger_ms = 0 if self.is_cut() else _LINGER_MS
            self.is_closed = True
            self._socket.disable_monitor()
            self._monitor.close()
            self._socket.close(linger_ms)
            self._context.term()


def _listening(address: str) -> int:
    """A listening socket, which may share its port with who reserved it."""
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, int(port)))
        listener.listen()
        return listener.detach()
