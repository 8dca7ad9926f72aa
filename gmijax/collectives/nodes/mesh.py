"""All-gather and all-reduce between the leaders of nodes, through TCP, in the order of nodes."""

from __future__ import annotations

import selectors
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from gmijax.clock import running_s
from gmijax.collectives.host.shared_memory_group import chunk
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.nodes.rendezvous import Sockets
from gmijax.collectives.waits import LIVENESS_PERIOD_S
from gmijax.errors import CollectiveError, CollectiveTimeout, PeerLost

_HEADER: Final = struct.Struct("<QQ")
"""Number of the call, and what it is; both equal at both ends."""


class Mesh:
    """One leader's use of its connections in one lane.

    Calls are collective: the leaders of all nodes make the same ones in the same order.

    Args:
      sockets: with the other nodes; not blocking.
      node: position of this one.
      ids: of the leaders, in order of nodes, for messages.
      timeout_s: longest wait for other nodes.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.
      on_wait: called five times a second while this waits.

    Raises:
      PeerLost, CollectiveTimeout: (from every call) a leader has hung up, or did not come in time.
      CollectiveError: (from every call) nodes make different calls.
    """

    def __init__(
        self,
        sockets: Sockets,
        node: int,
        ids: Sequence[int],
        *,
        timeout_s: float,
        rendezvous_timeout_s: float,
        on_wait: Callable[[], None],
    ) -> None:
        self._sockets, self._node, self._ids = sockets, node, ids
        self._timeout_s, self._rendezvous_timeout_s = timeout_s, rendezvous_timeout_s
        self._on_wait = on_wait
        self._calls = 0
        self._first_call = 1

    def restart(self) -> None:
        """Marks the calls so far as part of the start: the next one is the first."""
        self._first_call = self._calls + 1

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [N, n]: `values` [n] of every node, in order."""
        rows = np.empty((len(self._ids), values.size), np.float32)
        rows[self._node] = values
        self._swap("all_gather", values.size, lambda _: values, lambda node: rows[node])
        return rows

    def all_reduce(self, values: FloatBuffer, call_index: int) -> FloatBuffer:
        """Returns the sum over nodes, in their order, of `values` [n]; the same bits on all.

        Args:
          values: of this node.
          call_index: which exchange of its program this is.
        """
        num_nodes = len(self._ids)
        parts = [chunk(values.size, node, num_nodes) for node in range(num_nodes)]
        own = parts[self._node]
        rows = np.empty((num_nodes, own.stop - own.start), np.float32)
        rows[self._node] = values[own]
        word = values.size << 16 | (call_index & 0xFFFF)
        self._swap("sum", word, lambda node: values[parts[node]], lambda node: rows[node])
        total = np.empty_like(values)
        # Overflow and NaN are for the caller to judge, not worth a warning here.
        with np.errstate(over="ignore", invalid="ignore"):
            part = rows[0]
            for row in rows[1:]:
                part += row
        total[own] = part
        self._swap("sum", word, lambda _: part, lambda node: total[parts[node]])
        return total

    def close(self) -> None:
        """Hangs up."""
        for connection in self._sockets.values():
            connection.close()

    def _swap(
        self,
        operation: str,
        word: int,
        sent: Callable[[int], FloatBuffer],
        received: Callable[[int], FloatBuffer],
    ) -> None:
        """Sends every other node its `sent`, and fills its `received` with what it sends."""
        self._calls += 1
        header = _HEADER.pack(self._calls, word)
        swap = _Swap(self._sockets, header, sent, received)
        try:
            self._wait(swap, operation)
            if different := swap.different():
                raise CollectiveError(
                    f"step {self._calls}: GMI {self._ids[self._node]} calls {operation}, GMI "
                    f"{self._ids[different[0]]} something else, or of another size"
                )
        except ConnectionError:
            peer = self._ids[swap.at]
            raise PeerLost(
                self._ids[self._node], peer, f"{operation} between nodes", self._calls
            ) from None
        finally:
            swap.close()

    def _wait(self, swap: _Swap, operation: str) -> None:
        started_s = beat_s = running_s()
        is_first = self._calls <= self._first_call
        timeout_s = self._rendezvous_timeout_s if is_first else self._timeout_s
        while missing := swap.step():
            now_s = running_s()
            if now_s - beat_s >= LIVENESS_PERIOD_S:
                beat_s = now_s
                self._on_wait()
            if now_s - started_s >= timeout_s:
                late = tuple(self._ids[node] for node in missing)
                raise CollectiveTimeout(
                    *(self._ids[self._node], late, f"{operation} between nodes", self._calls),
                    timeout_s,
                )


class _Swap:
    """One exchange with all other nodes, in both directions at once.

    Attributes:
      at: the node whose connection was last looked at.
    """

    def __init__(
        self,
        sockets: Sockets,
        header: bytes,
        sent: Callable[[int], FloatBuffer],
        received: Callable[[int], FloatBuffer],
    ) -> None:
        self.at = -1
        self._header = header
        self._sockets = sockets
        self._headers = {node: bytearray(_HEADER.size) for node in sockets}
        self._out = {n: [memoryview(header), _bytes(sent(n))] for n in sockets}
        self._in = {n: [memoryview(self._headers[n]), _bytes(received(n))] for n in sockets}
        self._selector = selectors.DefaultSelector()
        for node, connection in sockets.items():
            self._selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE, node)

    def step(self) -> list[int]:
        """Moves what can be moved now, or waits a moment; nodes that have not sent all."""
        for key, events in self._selector.select(LIVENESS_PERIOD_S):
            node, connection = key.data, self._sockets[key.data]
            self.at = node
            if events & selectors.EVENT_WRITE:
                self._send(node, connection)
            if events & selectors.EVENT_READ:
                self._receive(node, connection)
            left = selectors.EVENT_WRITE if self._out[node] else 0
            left |= selectors.EVENT_READ if self._in[node] else 0
            if left:
                self._selector.modify(connection, left, node)
            else:
                self._selector.unregister(connection)
        return [node for node in self._sockets if self._in[node] or self._out[node]]

    def different(self) -> list[int]:
        """Nodes whose call was another one."""
        return [node for node, header in self._headers.items() if header != self._header]

    def close(self) -> None:
        """Ends the waiting; the connections stay."""
        self._selector.close()

    def _send(self, node: int, connection: socket.socket) -> None:
        views = self._out[node]
        while views:
            if not views[0]:
                views.pop(0)
                continue
            try:
                views[0] = views[0][connection.send(views[0]) :]
            except BlockingIOError:
                return

    def _receive(self, node: int, connection: socket.socket) -> None:
        views = self._in[node]
        while views:
            if not views[0]:
                views.pop(0)
                if self._headers[node] != self._header:
                    views.clear()  # What follows is of another size.
                continue
            try:
                count = connection.recv_into(views[0])
            except BlockingIOError:
                return
            if not count:
                raise ConnectionError("it has hung up")
            views[0] = views[0][count:]


def _bytes(values: FloatBuffer) -> memoryview:
    return values.view(np.uint8).data
