"""A job on the nodes of a cluster: checks before it starts, one attempt, what is left after it."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

from gmijax.cluster.checks import by_name, require_alike, require_shared
from gmijax.cluster.node import NodeEndpoints, TrainingNode
from gmijax.cluster.ray_nodes import NodeHandle, RayCluster
from gmijax.collectives.nodes.rendezvous import NodeAddresses
from gmijax.config import TrainConfig
from gmijax.errors import BackendUnavailable, ConfigError, GmiFailed
from gmijax.machine.snapshot import Machine
from gmijax.partition.placement import most_gmis_of_a_node, on_fewer_nodes
from gmijax.partition.planner import num_gmis_of
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.run_gmis import Launch, OnTick, taking_turns
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import WatchedGmi


class ClusterJob:
    """The nodes of a training job, to be entered with `with`.

    Args:
      config: of the job, with `cluster.engine`.
    """

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._joined: list[NodeHandle] = []
        self._signals: StopSignals | None = None
        self._num_cpus = _cpus_of_a_node(config)

    def __enter__(self) -> Self:
        self._cluster = RayCluster(self._config.cluster, TrainingNode)
        plan = self._config.plan
        on_gpus = plan.backend != "cpu" and (plan.backend != "auto" or self._cluster.has_gpus)
        num_gpus = plan.num_gpus if on_gpus else 0
        self._join = partial(
            self._cluster.join, self._num_cpus, least_gpus=num_gpus, most_gpus=num_gpus
        )
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
        self._joined = self._join(None if wanted == "auto" else wanted)
        self._run_root = run_root
        return self._checked()

    def join_again(self, num_nodes: int, *, elastic: bool) -> Mapping[str, Machine]:
        """Finds nodes for another attempt: so many, or fewer once the wait is over.

        Raises:
          ConfigError: as `join`; fewer nodes, and the job may not continue with them.
          JobInterrupted: a signal came.
        """
        least, signals = 1 if elastic else num_nodes, self._signals
        self._joined = self._join(
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
        try:
            opened = self._open(launch)
        except BackendUnavailable as error:
            launch = taking_turns(launch, error)
            opened = self._open(launch)
        addresses, calls = tuple(one.leader for one in opened), {}
        for one in opened:
            calls |= one.calls
        token = secrets.token_bytes(32)
        for number, (node, _) in enumerate(self._joined):
            node.call("set_addresses", NodeAddresses(number, addresses, token, calls))
        first = [gmis[0] for gmis in launch.plan.layout.gmis_of_node]
        for gmi, (node, _) in zip(first, self._joined, strict=True):
            if node.lost is not None:
                raise GmiFailed(gmi, node.lost)

        def start(gmi: int) -> WatchedGmi:
            node = self._joined[launch.plan.layout.node_of(gmi)].remote
            return node.start(gmi, launch.run.gmi(gmi))

        backend = BackendOfNodes(launch, self._joined)
        try:
            Supervisor(launch, backend, start=start, signals=signals).run(on_tick)
        finally:
            self._cluster.leave()

    def _open(self, launch: Launch) -> list[NodeEndpoints]:
        """What the nodes have for their GMIs; raises BackendUnavailable with a node's address."""
        sent = dataclasses.replace(launch, on_warning=print, is_enough=None)
        daemons: dict[str, Path] = {}
        found: list[NodeEndpoints] = []
        for number, (node, facts) in enumerate(self._joined):
            opened = node.call("open", sent, number, facts.address, daemons)
            if isinstance(opened, BackendUnavailable):
                raise BackendUnavailable(f"node {node.address}: {opened}")
            found.append(opened or NodeEndpoints(("", 0), {}, {}))  # None of a node that is gone.
            daemons |= found[-1].daemons
        return found

    def _checked(self) -> Mapping[str, Machine]:
        """The machines of the nodes, by address, once these can take part."""
        require_alike(self._joined)
        require_shared(self._joined, self._run_root)
        return {name: node.facts.machine for name, node in by_name(self._joined).items()}


class BackendOfNodes(Backend):
    """The backends that the nodes have entered, as the supervisor asks them."""

    def __init__(self, launch: Launch, joined: Sequence[NodeHandle]) -> None:
        super().__init__(launch.plan, launch.machine, launch.run)
        self._nodes = [node for node, _ in joined]

    def verify(self, pids: Mapping[int, int]) -> None:
        """See `Backend`."""
        for node, gmis in zip(self._nodes, self.plan.layout.gmis_of_node, strict=True):
            there = {gmi: pid for gmi, pid in pids.items() if gmi in gmis}
            if (without := node.call("verify", there)) is not None:
                raise GmiFailed(*without)

    def terminate(self, gmi: int, pids: Collection[int]) -> None:
        """See `Backend`."""
        self._nodes[self.plan.layout.node_of(gmi)].send("terminate", gmi, pids)


def _cpus_of_a_node(config: TrainConfig) -> int:
    """CPUs that every node must have: one for each of its GMIs, however many nodes are left."""
    if not config.is_decoupled:
        return num_gmis_of(config.plan)[0]
    wanted = config.cluster.nodes
    assert wanted != "auto"
    most = most_gmis_of_a_node(config.plan, wanted)
    for fewer in range(1, wanted if config.run.elastic else 1):
        with suppress(ConfigError):  # Then the job will not continue with so few.
            left = on_fewer_nodes(config.plan, wanted, fewer)
            most = max(most, most_gmis_of_a_node(left, fewer))
    return most
