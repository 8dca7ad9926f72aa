"""What ranks of several nodes do: through the block of their node, and between its leaders."""

from __future__ import annotations

import numpy as np

from gmijax.collectives.host.shared_block import MAX_GATHER_FLOATS
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.nodes.leader_watch import LeaderWatch
from gmijax.collectives.nodes.mesh import Mesh
from gmijax.collectives.strategies import Groups
from gmijax.partition.layout import Layout


class MultiNodeGroup:
    """`SharedMemoryGroup` of a job on several nodes, with a sum between nodes.

    Groups are of ranks of the whole job; those of a collective lie in one node.

    Attributes:
      local: the use of the block of the node, by ranks in the node.

    Args:
      local: this rank's use of the block of its node.
      layout: of the job.
      rank: of this process in the job.
      mesh: with the leaders of other nodes, None for ranks that do not lead.
      watch: the same, to see whether they live; the waits in `local` use it from here on.
    """

    def __init__(
        self,
        local: SharedMemoryGroup,
        layout: Layout,
        rank: int,
        mesh: Mesh | None = None,
        watch: LeaderWatch | None = None,
    ) -> None:
        self.rank, self.world_size = rank, layout.num_gmis
        self.local, self._mesh, self._watch = local, mesh, watch
        local.barrier.other_nodes = watch
        self._here = layout.gmis_of_node[layout.node_of(rank)]

    def all_reduce(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """See `SharedMemoryGroup`."""
        self.local.all_reduce(source, target, self.of_node(groups), call_index)

    def broadcast(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """See `SharedMemoryGroup`."""
        self.local.broadcast(source, target, self.of_node(groups), call_index)

    def all_gather_into(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int = 0
    ) -> None:
        """See `SharedMemoryGroup`."""
        self.local.all_gather_into(source, target, self.of_node(groups), call_index)

    def all_reduce_nodes(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, call_index: int
    ) -> None:
        """Writes the sum over nodes into `target` [n], of what their leaders have as `source`."""
        total = source if self._mesh is None else self._mesh.all_reduce(source, call_index)
        if self.local.world_size > 1:
            self.broadcast(total, target, groups, call_index)
        else:
            target[:] = total

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, M <= `MAX_GATHER_FLOATS`."""
        here = self.local.all_gather(values)
        everywhere = np.zeros(self.world_size * values.size, np.float32)
        if self._mesh is not None:
            everywhere[:] = self._mesh.all_gather(here.ravel()).ravel()
        for start in range(0, everywhere.size, MAX_GATHER_FLOATS):
            piece = everywhere[start : start + MAX_GATHER_FLOATS]
            # The leader is the first of its node. While it waits for others the limit is its own,
            # which in a first call is that of the start.
            piece[:] = self.local.all_gather(piece, while_unresponsive=True)[0]
        return everywhere.reshape(self.world_size, -1)

    def bootstrap_all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `SharedMemoryGroup`."""
        gathered = self.all_gather(values)
        self.local.barrier.restart()
        if self._mesh is not None:
            self._mesh.restart()
        return gathered

    def leader_barrier(self) -> None:
        """Waits for the leaders of all nodes in the call of `local` that is open.

        Raises:
          PeerLost, CollectiveTimeout: see `LeaderWatch`.
        """
        if self._watch is not None:
            barrier = self.local.barrier
            self._watch.barrier(barrier.limit_s, "step", barrier.step, self.local.heartbeat)

    def close(self) -> None:
        """Gives the memory back and hangs up. Idempotent."""
        self.local.close()
        if self._watch is not None:
            self._watch.close()
        if self._mesh is not None:
            self._mesh.close()

    def of_node(self, groups: Groups) -> Groups:
        """Those groups that are of this node, with ranks in the node."""
        first = self._here[0]
        return tuple(
            tuple(rank - first for rank in group) for group in groups if group[0] in self._here
        )
