"""Two nodes of Ray on this machine, for benchmarks and tests, in a process of their own.

As a command this is that process: it says where the nodes are and ends with its standard input. A
line there adds another node, for one that was killed. Ray in the process that uses the nodes would
start threads and warn there.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.runner import own_path
from gmijax.errors import ConfigError
from gmijax.supervise.failures import last_line

RAY = "cluster.engine=ray"

_NODE = {"object_store_memory": 80 << 20, "include_dashboard": False}
_QUICK = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 6,
}
"""So that a dead node is noticed in seconds."""


class Cluster:
    """Two nodes of Ray.

    Attributes:
      address: as an override.
      second_raylet: process of the node that does not lead the cluster.

    Raises:
      ConfigError: they do not start.
    """

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self._process, self._log = process, log
        self._read_nodes()

    def add_node(self) -> None:
        """Adds one in place of the second, which was killed."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"add\n")
        self._process.stdin.flush()
        self._read_nodes()

    def _read_nodes(self) -> None:
        assert self._process.stdout is not None
        lines = (json.loads(line) for line in self._process.stdout if line.startswith(b"{"))
        nodes: dict[str, Any] | None = next(lines, None)
        if nodes is None:
            raise ConfigError(f"no two nodes of Ray: {last_line(self._log)}")
        self.address = f"cluster.address={nodes['address']}"
        self.second_raylet: int = nodes["second_raylet"]


@contextmanager
def two_nodes(log: Path, gpus: Sequence[int] = (), num_cpus: int = 2) -> Iterator[Cluster]:
    """The nodes while it is entered.

    Args:
      log: gets their errors.
      gpus: indices of two, one for each node; none: what Ray finds.
      num_cpus: of each node, as Ray counts them.
    """
    words = [sys.executable, "-m", __spec__.name, f"--num-cpus={num_cpus}", *map(str, gpus)]
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            words,
            env={**os.environ, **own_path()},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
        ) as process,
    ):
        yield Cluster(process, log)
        process.communicate(timeout=120)


def main() -> None:
    """Starts them and waits."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--num-cpus", type=int, required=True)
    parser.add_argument("gpus", nargs="*")
    given = parser.parse_args()
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster as RayCluster

    node = {**_NODE, "num_cpus": given.num_cpus}
    first, other = ({**node, **_gpu(gpu)} for gpu in given.gpus or (None, None))
    cluster = RayCluster(initialize_head=True, head_node_args={**first, "_system_config": _QUICK})
    try:
        while True:
            second = cluster.add_node(**other)
            raylet = second.all_processes["raylet"][0].process.pid
            nodes = {"address": cluster.address, "second_raylet": raylet}
            sys.stdout.write(f"\n{json.dumps(nodes)}\n")
            sys.stdout.flush()
            if not sys.stdin.readline():
                break
    finally:
        for one in (*cluster.worker_nodes, cluster.head_node):
            # A test may have killed it.
            if one is not None:
                is_there = one.all_processes["raylet"][0].process.poll() is None
                cluster.remove_node(one, allow_graceful=is_there)


def _gpu(index: str | None) -> dict[str, Any]:
    if index is None:
        return {}
    return {"num_gpus": 1, "env_vars": {"CUDA_VISIBLE_DEVICES": index}}


if __name__ == "__main__":
    main()
