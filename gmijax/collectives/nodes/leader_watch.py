"""How the leader of a node sees whether other nodes live while devices wait for each other.

A device that waits in a ring for a GPU of another node sends nothing. So leaders have a connection
of their own with each other, and send a byte five times a second while they wait for anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from gmijax.clock import running_s
from gmijax.collectives.nodes.rendezvous import Sockets
from gmijax.collectives.waits import wait_until
from gmijax.errors import CollectiveTimeout, PeerLost

_WAITS: Final = b"."
_HAS_ARRIVED: Final = b"!"
_READ_BYTES: Final = 4096


class LeaderWatch:
    """One leader's view of the others; they make the same calls of `barrier`.

    Args:
      sockets: with the other nodes; not blocking.
      node: position of this one.
      ids: of the leaders, in order of nodes, for messages.
    """

    def __init__(self, sockets: Sockets, node: int, ids: Sequence[int]) -> None:
        self._sockets, self._node, self._ids = sockets, node, ids
        self._received_s = dict.fromkeys(sockets, running_s())
        self._arrivals = dict.fromkeys(sockets, 0)
        self._num_barriers = 0
        self._gone: set[int] = set()

    def beat(self) -> None:
        """Sends to the others that this node waits, and reads what they have sent."""
        self._send(_WAITS)
        self._receive()

    def look(self, since_s: float, timeout_s: float, operation: str, step: int) -> None:
        """`beat`, and an error if another node is gone, or silent since `since_s` for too long.

        Raises:
          PeerLost: a leader has disconnected before it reached the next barrier.
          CollectiveTimeout: nothing was received from a node for `timeout_s`.
        """
        self.beat()
        late = [node for node in self._sockets if self._arrivals[node] <= self._num_barriers]
        own = self._ids[self._node]
        if gone := [node for node in late if node in self._gone]:
            raise PeerLost(own, self._ids[gone[0]], f"{operation} of several nodes", step)
        limit_s = running_s() - timeout_s
        if silent := [n for n in late if max(self._received_s[n], since_s) <= limit_s]:
            missing = tuple(self._ids[node] for node in silent)
            raise CollectiveTimeout(own, missing, f"{operation} of several nodes", step, timeout_s)

    def barrier(
        self, timeout_s: float, operation: str, step: int, on_wait: Callable[[], None]
    ) -> None:
        """Waits for the other leaders; time only counts while one is silent.

        Args:
          timeout_s: longest silence.
          operation: for messages.
          step: the same.
          on_wait: called five times a second.

        Raises:
          PeerLost, CollectiveTimeout: see `look`.
        """
        self._send(_HAS_ARRIVED)
        since_s = running_s()

        def have_arrived() -> bool | None:
            self._receive()
            return min(self._arrivals.values()) > self._num_barriers or None

        def check() -> None:
            on_wait()
            self.look(since_s, timeout_s, operation, step)

        wait_until(have_arrived, check, float("inf"))
        self._num_barriers += 1

    def close(self) -> None:
        """Hangs up."""
        for connection in self._sockets.values():
            connection.close()

    def _send(self, data: bytes) -> None:
        for connection in self._sockets.values():
            # It is gone, which `look` reports, or has not read what was sent for hours.
            with suppress(OSError):
                connection.send(data)

    def _receive(self) -> None:
        for node, connection in self._sockets.items():
            try:
                data = connection.recv(_READ_BYTES)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                self._received_s[node] = running_s()
                self._arrivals[node] += data.count(_HAS_ARRIVED)
            else:
                self._gone.add(node)
