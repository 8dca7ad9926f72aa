"""What the nodes of a cluster are, and in what they differ, for `gmijax.doctor`."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from gmijax.cluster.checks import by_name, differences_in_versions
from gmijax.cluster.node import Facts, Node
from gmijax.cluster.ray_nodes import RayCluster
from gmijax.config import ClusterConfig
from gmijax.errors import ConfigError, NodeLost
from gmijax.machine.differences import differences_in, differences_in_gpus, gpu_names

_LITTLE: Final = 0.001
"""Of a CPU: it is asked of each node, and must be had where jobs run."""

_CLOCKS_S: Final = 1.0
"""Clocks that differ by more make times in logs and events hard to compare."""


class NodeInfo(NamedTuple):
    """A node.

    Attributes:
      facts: what it is, with all GPUs of the machine.
      clock_s: how much its clock is ahead of this machine's.
    """

    facts: Facts
    clock_s: float


class SurveyedNode(Node):
    """A node that is only looked at: it sees all GPUs, also those in use."""

    def facts(self, version: str) -> Facts | str:
        """See `Node`."""
        # Ray hides the GPUs that were not asked for.
        os.environ.pop("CUDA_VISIBLE_DEVICES", None)
        return super().facts(version)

    def clock(self) -> float:
        """Seconds since the epoch."""
        return time.time()


def survey(address: str) -> dict[str, NodeInfo]:
    """All nodes of the cluster of Ray at this address, by theirs.

    Args:
      address: as `cluster.address`; in errors it is `cluster`.

    Raises:
      ConfigError: there is no cluster.
      NodeLost: a node is gone while it is asked.
    """
    try:
        return _survey(address)
    except ConfigError as error:
        text = str(error)
        for key in ("cluster.engine=ray", f"cluster.address={address}"):  # Not typed.
            text = text.replace(f"{key}: ", f"cluster={address}: ", 1)
        raise ConfigError(text) from None


def _survey(address: str) -> dict[str, NodeInfo]:
    cluster = RayCluster(ClusterConfig(engine="ray", address=address, wait_s=0.0), SurveyedNode)
    try:
        found: dict[str, NodeInfo] = {}
        for name, node in by_name(cluster.join(_LITTLE, None)).items():
            before_s = time.time()
            theirs_s = node.remote.call("clock")
            if node.remote.lost is not None:
                raise NodeLost(node.remote.lost)
            found[name] = NodeInfo(node.facts, theirs_s - (before_s + time.time()) / 2)
        return found
    finally:
        cluster.close()


def differences(nodes: Mapping[str, NodeInfo]) -> tuple[list[str], list[str]]:
    """What a job over these nodes would refuse, and what else is worth knowing, in sentences."""
    machines = {name: node.facts.machine for name, node in nodes.items()}
    problems = differences_in_versions({name: node.facts for name, node in nodes.items()})
    on_gpus, notes = differences_in_gpus(machines)
    notes += differences_in("CPU cores", {n: str(len(m.cpu_cores)) for n, m in machines.items()})
    notes += [
        f"the clock of {name} is {node.clock_s:+.1f} s from that of this machine"
        for name, node in nodes.items()
        if abs(node.clock_s) > _CLOCKS_S
    ]
    return problems + on_gpus, notes


def lines_of_nodes(nodes: Mapping[str, NodeInfo]) -> Iterator[str]:
    """Every node in a line."""
    for name, (facts, clock_s) in nodes.items():
        machine = facts.machine
        yield (
            f"node {name}: gmijax {facts.versions['gmijax']}, Python {facts.versions['python']}, "
            f"jax {facts.versions['jax']}, {len(machine.cpu_cores)} CPU cores, NVIDIA driver "
            f"{machine.driver_version or 'none'}, GPUs {gpu_names(machine)}, "
            f"clock {clock_s:+.3f} s"
        )


def nodes_as_data(nodes: Mapping[str, NodeInfo]) -> list[dict[str, Any]]:
    """Plain data for `--json`."""
    return [
        {
            "address": name,
            "versions": node.facts.versions,
            "cpu_cores": len(node.facts.machine.cpu_cores),
            "driver": node.facts.machine.driver_version,
            "gpus": [gpu._asdict() for gpu in node.facts.machine.gpus],
            "clock_s": node.clock_s,
        }
        for name, node in nodes.items()
    ]
