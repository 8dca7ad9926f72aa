"""A job on the nodes of a cluster: checks before it starts, one attempt, what is left after it."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from gmijax.cluster.checks import by_name, require_alike, require_shared
from gmijax.cluster.node import Opened, TrainingNode
from gmijax.cluster.ray_nodes import Joined, RayCluster
from gmijax.collectives.nodes.meeting import Nodes
from gmijax.config import TrainConfig
from gmijax.errors import ConfigError, GmiFailed
from gmijax.machine.snapshot import Machine
from gmijax.partition.placement import most_gmis_of_a_node
from gmijax.partition.planner import num_gmis_of
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.launcher import Launch, OnTick, StopSignals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import WatchedGmi


class ClusterJob:
    """The nodes of a training job, to be entered with `with`.

    Args:
      config: of the job, with `cluster.engine`.
    """

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._joined: list[Joined] = []
        self._signals: StopSignals | None = None
        self._num_cpus = _cpus_of_a_node(config)

    def __enter__(self) -> Self:
        self._cluster = RayCluster(self._config.cluster, TrainingNode)
        return self

    def __exit__(self, *exc: Any) -> None:
        self._cluster.close()

    def join(self, run_root: Path) -> Mapping[str, Machine]:
        """Finds the nodes of the first attempt; their machines by address.

        Args:
          run_root: the run folder, which may not be there yet.

        Raises:
          ConfigError: too few nodes, or one that cannot take part.
        """
        wanted = self._config.cluster.nodes
        self._joined = self._cluster.join(self._num_cpus, None if wanted == "auto" else wanted)
        self._run_root = run_root
        return self._checked()

    def join_again(self, num_nodes: int, *, elastic: bool) -> Mapping[str, Machine]:
        """Finds nodes for another attempt: so many, or fewer once the wait is over.

        Raises:
          ConfigError: as `join`; fewer nodes, and the job may not go on with them.
          JobInterrupted: a signal came.
        """
        least, signals = 1 if elastic else num_nodes, self._signals
        self._joined = self._cluster.join(
            self._num_cpus,
            num_nodes,
            least=least,
            is_unwanted=lambda: signals is not None and signals.have_come,
        )
        return self._checked()

    def run(self, launch: Launch, on_tick: OnTick, signals: StopSignals) -> None:
        """Runs all GMIs of a plan on the nodes that have joined; see `run_gmis`.

        Raises:
          GmiFailed, ConfigError, JobInterrupted: as `run_gmis`.
        """
        self._signals = signals
        sent = dataclasses.replace(launch, on_warning=print, is_enough=None)
        token, addresses, calls = secrets.token_bytes(32), [], {}
        for place, (node, facts) in enumerate(self._joined):
            opened = node.call("open", sent, place, facts.address) or Opened(("", 0), {})
            addresses.append(opened.leader)
            calls |= opened.calls
        for place, (node, _) in enumerate(self._joined):
            node.call("introduce", Nodes(place, tuple(addresses), token, calls))
        first = [gmis[0] for gmis in launch.plan.layout.gmis_of_node]
        for gmi, (node, _) in zip(first, self._joined, strict=True):
            if node.lost is not None:
                raise GmiFailed(gmi, node.lost)

        def start(gmi: int, waits: bool) -> WatchedGmi:
            node = self._joined[launch.plan.layout.node_of(gmi)].remote
            return node.start(gmi, waits, launch.run.gmi(gmi))

        # Backends are entered on the nodes.
        backend = Backend(launch.plan, launch.machine, launch.run)
        supervisor = Supervisor(launch, backend, start=start)
        signals.forward_to(supervisor.request_stop)
        try:
            supervisor.run(on_tick)
        finally:
            self._cluster.leave()

    def _checked(self) -> Mapping[str, Machine]:
        """The machines of the nodes, by address, once these can take part."""
        require_alike(self._joined, has_tcp=self._config.is_asynchronous)
        require_shared(self._joined, self._run_root)
        return {name: node.facts.machine for name, node in by_name(self._joined).items()}


def _cpus_of_a_node(config: TrainConfig) -> int:
    """CPUs that every node must have: one for each of its GMIs, however many nodes are left."""
    if not config.is_asynchronous:
        return num_gmis_of(config.plan)[0]
    wanted = config.cluster.nodes
    assert wanted != "auto"
    most = most_gmis_of_a_node(config.plan, wanted)
    for fewer in range(1, wanted if config.run.elastic else 1):
        with suppress(ConfigError):  # Then the job will not go on with so few.
            most = max(most, most_gmis_of_a_node(config.plan, fewer))
    return most
