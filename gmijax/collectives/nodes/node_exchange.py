"""What ranks of several nodes do: through the block of their node, and between its leaders."""

from __future__ import annotations

import numpy as np

from gmijax.collectives.host.host_exchange import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.nodes.mesh import Mesh
from gmijax.collectives.strategies import Groups
from gmijax.partition.layout import Layout


class NodeExchange:
    """`HostExchange` of a job on several nodes, with a sum between nodes.

    Groups are of ranks of the whole job; those of a sum, a gather or a broadcast lie in one node.

    Args:
      local: this rank's use of the block of its node.
      layout: of the job.
      rank: of this process in the job.
      mesh: with the leaders of other nodes, None for ranks that do not lead.
    """

    def __init__(self, local: HostExchange, layout: Layout, rank: int, mesh: Mesh | None) -> None:
        self.rank, self.world_size = rank, layout.num_gmis
        self._local, self._mesh = local, mesh
        self._here = layout.gmis_of_node[layout.node_of(rank)]

    def sum(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, place: int = 0
    ) -> None:
        """See `HostExchange`."""
        self._local.sum(source, target, self._of_node(groups), place)

    def broadcast(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, place: int = 0
    ) -> None:
        """See `HostExchange`."""
        self._local.broadcast(source, target, self._of_node(groups), place)

    def gather(
        self, source: FloatBuffer, target: FloatBuffer, groups: Groups, place: int = 0
    ) -> None:
        """See `HostExchange`."""
        self._local.gather(source, target, self._of_node(groups), place)

    def sum_between_nodes(self, source: FloatBuffer, target: FloatBuffer, place: int) -> None:
        """Writes the sum over leaders of `source` [n] into `target` [n]; for others `source`."""
        target[:] = source if self._mesh is None else self._mesh.sum(source, place)

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, K M <= `MAX_GATHER_FLOATS`."""
        here = self._local.all_gather(values)
        everywhere = np.zeros(self.world_size * values.size, np.float32)
        if self._mesh is not None:
            everywhere[:] = self._mesh.gather(here.ravel()).ravel()
        # The leader is the first of its node.
        return self._local.all_gather(everywhere)[0].reshape(self.world_size, -1)

    def close(self) -> None:
        """Gives the memory back and hangs up. Idempotent."""
        self._local.close()
        if self._mesh is not None:
            self._mesh.close()

    def _of_node(self, groups: Groups) -> Groups:
        """Those groups that are of this node, with ranks in the node."""
        first = self._here[0]
        return tuple(
            tuple(rank - first for rank in group) for group in groups if group[0] in self._here
        )
