"""How the leaders of nodes find each other, and prove that they belong to one job.

Before a GMI is started every node opens a listening socket, which its leader inherits; then all
leaders get all addresses, and a secret. Node i connects to the nodes before it, and both ends
prove that they know the secret (`handshake.py`). Once all are connected, the sockets are closed.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.clock import running_s
from gmijax.collectives.nodes.handshake import Key, Unreachable, accepted, call
from gmijax.collectives.shared_memory import create_file
from gmijax.errors import CollectiveError

ENV_NODES_FD: Final = "GMIJAX_NODES_FD"
"""Names the descriptor of a file of `NodeAddresses`."""

ENV_LISTENER_FD: Final = "GMIJAX_LISTENER_FD"
"""Names the descriptor of the node's listening socket."""


class NodeAddresses(NamedTuple):
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
    def from_file(cls, fd: int) -> NodeAddresses:
        """Inverts `to_file`."""
        node, hosts_and_ports, token, calls = json.loads(os.pread(fd, os.fstat(fd).st_size, 0))
        addresses = tuple((host, port) for host, port in hosts_and_ports)
        pairs = {(listener, caller): address for listener, caller, address in calls}
        return cls(node, addresses, bytes.fromhex(token), pairs)

    def among(self, nodes: Sequence[int]) -> NodeAddresses:
        """The leaders of these nodes alone, this one among them."""
        addresses = tuple(self.addresses[node] for node in nodes)
        return self._replace(node=nodes.index(self.node), addresses=addresses)


def inherited_nodes() -> tuple[NodeAddresses | None, socket.socket | None]:
    """What this process inherited of the two above; neither in a job on one machine."""
    if ENV_NODES_FD not in os.environ:
        return None, None
    nodes_fd, listener_fd = int(os.environ[ENV_NODES_FD]), int(os.environ[ENV_LISTENER_FD])
    os.set_inheritable(listener_fd, False)
    nodes = NodeAddresses.from_file(nodes_fd)
    os.close(nodes_fd)
    return nodes, socket.socket(fileno=listener_fd)


Sockets = Mapping[int, socket.socket]
"""The connections of one lane with the other nodes, by their positions."""


def listen(address: str) -> socket.socket:
    """A socket that listens at a free port of this IP address."""
    return socket.create_server((address, 0), backlog=128)


@contextmanager
def reserved_address(host: str) -> Iterator[str]:
    """`host:port`, which no other user can take before the GMI that gets it listens there."""
    # Bound without listening, and shared with this user: connections go to the GMI that listens.
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        holder.bind((host, 0))
        yield f"{host}:{holder.getsockname()[1]}"


def connect(
    nodes: NodeAddresses, listener: socket.socket, num_lanes: int, timeout_s: float
) -> list[Sockets]:
    """Connects this node's leader with those of all others, once for each lane.

    Raises:
      CollectiveError: a node cannot be reached, or does not come in time.
    """
    deadline_s = running_s() + timeout_s
    lanes: list[dict[int, socket.socket]] = [{} for _ in range(num_lanes)]
    try:
        for lane, connections in enumerate(lanes):
            for node in range(nodes.node):
                connections[node] = _call(nodes, node, lane, deadline_s)
        if nodes.node + 1 < len(nodes.addresses):
            _accept(nodes, listener, lanes, deadline_s)
    except BaseException:
        for connections in lanes:
            for connection in connections.values():
                connection.close()
        raise
    return list(lanes)


def _call(nodes: NodeAddresses, node: int, lane: int, deadline_s: float) -> socket.socket:
    address = nodes.addresses[node]
    where = f"node {node} at {address[0]}:{address[1]}"
    key = Key(nodes.token, _name_of_listener(node))
    try:
        return call(address, key, (nodes.node, lane), lambda: deadline_s - running_s())
    except Unreachable as error:
        raise CollectiveError(
            f"node {nodes.node} cannot reach {where} ({error}); cluster.interface sets the "
            "network to use"
        ) from None
    except OSError as error:
        raise CollectiveError(
            f"node {nodes.node} has a connection with {where}, but no answer of this job ({error})"
        ) from None


def _accept(
    nodes: NodeAddresses,
    listener: socket.socket,
    lanes: Sequence[dict[int, socket.socket]],
    deadline_s: float,
) -> None:
    """Fills in the connections of all nodes behind this one."""
    expected = range(nodes.node + 1, len(nodes.addresses))
    missing = {(node, lane) for node in expected for lane in range(len(lanes))}
    key = Key(nodes.token, _name_of_listener(nodes.node))
    with closing(accepted(listener, key, lambda: deadline_s - running_s())) as callers:
        for connection, (node, lane) in callers:
            if lane >= len(lanes) or node not in expected:
                connection.close()
                continue
            if node in lanes[lane]:  # The network has lost what it had.
                lanes[lane][node].close()
            lanes[lane][node] = connection
            missing.discard((node, lane))
            if not missing:
                return
    late = ", ".join(map(str, sorted({node for node, _ in missing})))
    raise CollectiveError(f"node {nodes.node}: the leaders of other nodes did not come: {late}")


def _name_of_listener(node: int) -> str:
    return f"node {node}"
