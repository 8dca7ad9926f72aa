"""Collectives between ranks on different GPUs: NCCL through nccl4py, as work of a stream."""

from __future__ import annotations

import importlib
import sys
from contextlib import suppress
from typing import Any

from gmijax.collectives.all_or_none import Group, all_or_none
from gmijax.collectives.strategies import Groups

_FEATURE = "rings between GPUs"


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
        """Gives the communicator back, at once if an error is what ends it. Idempotent.

        Errors that NCCL then reports are ignored: callers that wait for a sum have seen them.
        """
        comm, self._comm = self._comm, None
        if comm is None:
            return
        # To destroy one may wait for the other members, some of which may not have joined.
        give_back = self._nccl.comm_destroy if sys.exception() is None else self._nccl.comm_abort
        with suppress(Exception):
            give_back(comm)


def nccl_ring(group: Group, rings: Groups) -> NcclRing | None:
    """Joins the ring that this rank is in, None if it is in none; all ranks of the job call it.

    `rings` are of ranks in the job; the members of one may be on several nodes. Where they listen
    NCCL decides, by `NCCL_SOCKET_IFNAME`.

    Raises:
      DeviceMemoryUnavailable: NCCL is not to be had, or refuses; on all ranks alike.
    """
    joined: list[NcclRing] = []
    rank = group.rank
    members = next((ring for ring in rings if rank in ring), ())

    def make_id() -> bytes:
        if not members:
            return b""
        # By all members: one that cannot import it must not leave others waiting in `join`.
        nccl = _nccl()
        return bytes(nccl.get_unique_id()) if members[0] == rank else b""

    def join() -> bytes:
        if members:
            nccl = _nccl()
            unique = nccl.UniqueId.from_buffer(ids[members[0]][:_ID_BYTES].tobytes())
            comm = nccl.comm_init_rank(len(members), unique, members.index(rank))
            joined.append(NcclRing(nccl, comm))
        return b""

    ids = all_or_none(group, _FEATURE, make_id)
    try:
        all_or_none(group, _FEATURE, join)
    except BaseException:
        for ring in joined:
            ring.close()
        raise
    return joined[0] if joined else None


_ID_BYTES = 128


def _nccl() -> Any:
    # By name, because it has no type information, and is not installed everywhere.
    return importlib.import_module("nccl.bindings.nccl")
