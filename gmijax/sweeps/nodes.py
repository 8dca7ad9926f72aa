"""Nodes of a cluster of Ray that run jobs of a sweep, each as one machine does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

from gmijax.cluster.checks import by_name, require_alike, require_shared
from gmijax.cluster.node import Node
from gmijax.cluster.ray_nodes import NodeHandle, RayCluster
from gmijax.config import ClusterConfig
from gmijax.config.sweep import JobsConfig
from gmijax.errors import ConfigError, GmijaxError, NodeLost
from gmijax.machine.nvidia import GpuLoad
from gmijax.machine.processes import ProcessId
from gmijax.machine.snapshot import detect_machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.sweeps.children import ChildStatus
from gmijax.sweeps.host import ChildStart, LocalHost, Order


class SweepNode(Node):
    """A node's part of a sweep: a `LocalHost` in an actor of Ray, with whose end its jobs end."""

    def __init__(
        self, variables: Mapping[str, str], folder: str, interface: str | None, address: str
    ) -> None:
        super().__init__(variables, folder, interface, address)
        self._host = LocalHost(detect_machine())

    def do(self, method: str, *arguments: Any) -> Any:
        """What a method of the host returns, or the error of ours that it raises."""
        try:
            return getattr(self._host, method)(*arguments)
        except GmijaxError as error:
            return error

    def poll(self) -> dict[int, ChildStatus]:
        """How every child is; for `RemoteNode.look`."""
        return self._host.look_at_all()

    def order(self, child: int, order: Order) -> None:
        """See `LocalHost`."""
        self._host.order(child, order)

    def close(self) -> None:
        """See `Node`."""
        self._host.close()


class RemoteHost:
    """A node as the scheduler sees it, with the methods of a `LocalHost`.

    Those that need an answer raise `NodeLost` if it is gone.

    Attributes:
      left: see `LocalHost`; of a node that is not known.
    """

    left: tuple[tuple[Path, ProcessId], ...] = ()

    def __init__(self, joined: NodeHandle, name: str) -> None:
        self.name: str | None = name
        self.machine = joined.facts.machine
        self._node = joined.remote
        self._run: RunPaths | None = None

    @property
    def lost(self) -> str | None:
        """See `LocalHost`."""
        return self._node.lost

    def lease(self, devices: Iterable[str]) -> str | None:
        """See `LocalHost`."""
        return self._do("lease", tuple(devices))

    def open(self, plan: Plan, run: RunPaths) -> None:
        """See `LocalHost`."""
        self._run = run
        self._do("open", plan, run)

    def start(self, start: ChildStart) -> int:
        """See `LocalHost`."""
        return self._do("start", start)

    def look(self, child: int) -> ChildStatus | None:
        """See `LocalHost`."""
        return self._node.look(child)

    def order(self, child: int, order: Order) -> None:
        """See `LocalHost`."""
        self._node.order(child, order)

    def why_no_client(self, child: int) -> str | None:
        """See `LocalHost`."""
        with suppress(NodeLost):
            return self._do("why_no_client", child)
        return None

    def load_of(self, device: str) -> GpuLoad | None:
        """See `LocalHost`."""
        with suppress(NodeLost):
            return self._do("load_of", device)
        return None

    def shut(self) -> None:
        """See `LocalHost`."""
        with suppress(NodeLost):
            self._do("shut")
        if self._run is not None:
            with suppress(OSError):  # Logs are kept.
                self._run.root.rmdir()

    def _do(self, method: str, *arguments: Any) -> Any:
        answer = self._node.call("do", method, *arguments)
        if self._node.lost is not None:
            raise NodeLost(self._node.lost)
        if isinstance(answer, GmijaxError):
            raise answer
        return answer


Host: TypeAlias = LocalHost | RemoteHost
"""A machine of a sweep."""


@contextmanager
def nodes_of(
    cluster: ClusterConfig, settings: JobsConfig, on_cpu: bool, processes: int, root: Path
) -> Iterator[list[RemoteHost]]:
    """The nodes of a sweep while it is entered.

    Args:
      cluster: where they are.
      settings: of the jobs.
      on_cpu: whether no job wants a GPU.
      processes: of the largest job at each of its slots, for which there must be CPUs.
      root: their folder, which may not be there yet.

    Raises:
      ConfigError: as `RayCluster` and `RayCluster.join`; a node that cannot take part.
    """
    if isinstance(settings.gpus, tuple):
        raise ConfigError(
            f"{settings.prefix}gpus={list(settings.gpus)}: Ray chooses the GPUs of nodes; "
            "expected a number, of each node, or null"
        )
    wanted = None if cluster.nodes == "auto" else cluster.nodes
    ray = RayCluster(cluster, SweepNode)
    try:
        joined = ray.join(
            num_cpus_of(settings, processes), wanted, most_gpus=0 if on_cpu else settings.gpus
        )
        require_alike(joined)
        require_shared(joined, root)
        yield [RemoteHost(node, name) for name, node in by_name(joined).items()]
    finally:
        ray.close()


def num_cpus_of(settings: JobsConfig, processes: int) -> int:
    """CPUs of each node that Ray is asked for: one for every GMI that the settings name."""
    each = 1 if settings.jobs_per_gpu == "auto" else settings.jobs_per_gpu
    gpus = settings.gpus if isinstance(settings.gpus, int) else 1
    return gpus * each * processes
