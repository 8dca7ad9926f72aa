"""How the leaders of nodes find each other, and prove that they belong to one job.

Before a GMI is started every node opens a listening socket, which its leader inherits; then all
leaders are told all addresses, and a secret. Node i connects to the nodes before it. Each end of a
connection sends a random number and answers that of the other with its HMAC under the secret:
whoever does not know it is hung up on. What is sent afterwards is neither encrypted nor signed.
"""

from __future__ import annotations

import hmac
import json
import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.collectives.shared_memory import create_file
from gmijax.errors import CollectiveError

ENV_NODES_FD: Final = "GMIJAX_NODES_FD"
"""Names the descriptor of a file of `Nodes`."""

ENV_LISTENER_FD: Final = "GMIJAX_LISTENER_FD"
"""Names the descriptor of the node's listening socket."""

_NONCE_BYTES = 32
_HELLO: Final = struct.Struct("<II")
_STRANGER_S = 5.0
"""Longest wait for somebody who has connected to say who it is."""


class Nodes(NamedTuple):
    """What the GMIs of a job know of those of other nodes.

    Attributes:
      node: whose view this is, position of its node.
      addresses: where the leader of every node listens, in order: IP address and port.
      token: the secret of the job.
      calls: where one GMI listens for another by itself, `host:port` by (listens, calls).
    """

    node: int
    addresses: tuple[tuple[str, int], ...]
    token: bytes
    calls: Mapping[tuple[int, int], str] = MappingProxyType({})

    def to_file(self) -> int:
        """A descriptor of memory without a name that holds it; the caller closes it."""
        fd = create_file("nodes")
        calls = [[*pair, address] for pair, address in self.calls.items()]
        text = json.dumps([self.node, self.addresses, self.token.hex(), calls])
        os.pwrite(fd, text.encode(), 0)
        return fd

    @classmethod
    def from_file(cls, fd: int) -> Nodes:
        """Inverts `to_file`."""
        node, found, token, calls = json.loads(os.pread(fd, os.fstat(fd).st_size, 0))
        addresses = tuple((host, port) for host, port in found)
        pairs = {(listener, caller): address for listener, caller, address in calls}
        return cls(node, addresses, bytes.fromhex(token), pairs)

    def among(self, nodes: Sequence[int]) -> Nodes:
        """The leaders of these nodes alone, this one among them."""
        addresses = tuple(self.addresses[node] for node in nodes)
        return self._replace(node=nodes.index(self.node), addresses=addresses)


def inherited_nodes() -> tuple[Nodes | None, socket.socket | None]:
    """What this process inherited of the two above; neither in a job on one machine."""
    if ENV_NODES_FD not in os.environ:
        return None, None
    nodes_fd, listener_fd = int(os.environ[ENV_NODES_FD]), int(os.environ[ENV_LISTENER_FD])
    os.set_inheritable(listener_fd, False)
    nodes = Nodes.from_file(nodes_fd)
    os.close(nodes_fd)
    return nodes, socket.socket(fileno=listener_fd)


Sockets = Mapping[int, socket.socket]
"""The connections of one lane with the other nodes, by their positions."""


def listen(address: str) -> socket.socket:
    """A socket that listens at a free port of this IP address."""
    return socket.create_server((address, 0), backlog=128)


@contextmanager
def reserved_address(host: str) -> Iterator[str]:
    """`host:port`, which cannot go to somebody else before the GMI that gets it listens there."""
    # Bound without listening, and shared with this user: connections go to who listens.
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        holder.bind((host, 0))
        yield f"{host}:{holder.getsockname()[1]}"


def connect(
    nodes: Nodes, listener: socket.socket, num_lanes: int, timeout_s: float
) -> list[Sockets]:
    """Connects this node's leader with those of all others, once for each lane.

    Raises:
      CollectiveError: a node cannot be reached, or does not come in time.
    """
    deadline_s = time.monotonic() + timeout_s
    lanes: list[dict[int, socket.socket]] = [{} for _ in range(num_lanes)]
    try:
        for lane, found in enumerate(lanes):
            for node in range(nodes.node):
                found[node] = _call(nodes, node, lane, timeout_s)
        num_missing = num_lanes * (len(nodes.addresses) - 1 - nodes.node)
        while num_missing:
            accepted = _accept(nodes, listener, deadline_s)
            if accepted is not None:
                connection, node, lane = accepted
                lanes[lane][node] = connection
                num_missing -= 1
    except BaseException:
        for found in lanes:
            for connection in found.values():
                connection.close()
        raise
    return list(lanes)


def _call(nodes: Nodes, node: int, lane: int, timeout_s: float) -> socket.socket:
    host, port = nodes.addresses[node]
    connection = None
    try:
        connection = socket.create_connection((host, port), timeout_s)
        _prove(connection, nodes.token, b"calls", b"called")
        connection.sendall(_HELLO.pack(nodes.node, lane))
    except OSError as error:
        if connection is not None:
            connection.close()
        raise CollectiveError(
            f"node {nodes.node} cannot reach node {node} at {host}:{port} "
            f"({error.strerror or error}); cluster.interface says which network to use"
        ) from None
    return _ready(connection)


def _accept(
    nodes: Nodes, listener: socket.socket, deadline_s: float
) -> tuple[socket.socket, int, int] | None:
    """A connection of a leader, its node and lane; None for a stranger's."""
    listener.settimeout(max(0.01, deadline_s - time.monotonic()))
    try:
        connection, _ = listener.accept()
    except TimeoutError:
        raise CollectiveError(f"node {nodes.node}: leaders of other nodes did not come") from None
    connection.settimeout(_STRANGER_S)
    with suppress(OSError):
        _prove(connection, nodes.token, b"called", b"calls")
        node, lane = _HELLO.unpack(_read(connection, _HELLO.size))
        return _ready(connection), node, lane
    connection.close()
    return None


def _prove(connection: socket.socket, token: bytes, own: bytes, other: bytes) -> None:
    """Proves to the other end that this one knows the token, and has it prove the same.

    Raises:
      ConnectionError: it does not know it.
    """
    nonce = os.urandom(_NONCE_BYTES)
    connection.sendall(nonce)
    # With a role in it, so that nobody can send back what was sent.
    connection.sendall(hmac.digest(token, own + _read(connection, _NONCE_BYTES), "sha256"))
    expected = hmac.digest(token, other + nonce, "sha256")
    if not hmac.compare_digest(_read(connection, len(expected)), expected):
        raise ConnectionError("it is not of this job")


def _read(connection: socket.socket, num_bytes: int) -> bytes:
    received = b""
    while len(received) < num_bytes:
        part = connection.recv(num_bytes - len(received))
        if not part:
            raise ConnectionError("it has hung up")
        received += part
    return received


def _ready(connection: socket.socket) -> socket.socket:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setblocking(False)
    return connection
