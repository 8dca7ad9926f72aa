"""Collectives between ranks on different GPUs: NCCL through nccl4py, as work of a stream."""

from __future__ import annotations

import importlib
from typing import Any

from gmijax.collectives.device.shared_slots import agreed
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.collectives.strategies import Groups

_WISH = "rings between GPUs"


class NcclRing:
    """This rank's collectives with others, each on another GPU; adds work to a stream.

    `nccl` is the module `nccl.bindings.nccl`, and `comm` a communicator of it.
    """

    def __init__(self, nccl: Any, comm: Any) -> None:
        self._nccl, self._comm = nccl, comm
        self._float, self._sum = int(nccl.DataType.Float32), int(nccl.RedOp.Sum)

    def all_gather(self, stream: int, source: int, target: int, num_floats: int) -> None:
        """`target` [m, n] becomes what all members have."""
        self._nccl.all_gather(source, target, num_floats, self._float, self._comm, stream)

    def all_reduce(self, stream: int, source: int, target: int, num_floats: int) -> None:
        """`target` [n] becomes the sum over the members."""
        kind = self._float, self._sum
        self._nccl.all_reduce(source, target, num_floats, *kind, self._comm, stream)

    def broadcast(self, stream: int, source: int, target: int, num_floats: int) -> None:
        """`target` [n] becomes what the first member has."""
        kind = self._float, 0
        self._nccl.broadcast(source, target, num_floats, *kind, self._comm, stream)

    def close(self) -> None:
        """Gives the communicator back. Idempotent."""
        if self._comm is not None:
            self._nccl.comm_destroy(self._comm)
        self._comm = None


def nccl_ring(host: SharedMemoryGroup | MultiNodeGroup, groups: Groups) -> NcclRing | None:
    """Meets the other members of this rank's group; all ranks of the job call it.

    On several nodes rings are in each of them, and `groups` are of ranks in the node.

    Raises:
      DeviceMemoryUnavailable: NCCL is not to be had, or refuses; on all ranks alike.
    """
    found: list[NcclRing] = []
    rank = host.local.rank
    group = next((group for group in groups if rank in group), ())

    def make_id() -> bytes:
        if not group or group[0] != rank:
            return b""
        return bytes(_nccl().get_unique_id())

    def join() -> bytes:
        if group:
            nccl = _nccl()
            unique = nccl.UniqueId.from_buffer(ids[group[0]][:_ID_BYTES].tobytes())
            place = group.index(rank)
            found.append(NcclRing(nccl, nccl.comm_init_rank(len(group), unique, place)))
        return b""

    ids = agreed(host, _WISH, make_id)
    agreed(host, _WISH, join)
    return found[0] if found else None


_ID_BYTES = 128


def _nccl() -> Any:
    # By name, because it has no type information, and is not installed everywhere.
    return importlib.import_module("nccl.bindings.nccl")
