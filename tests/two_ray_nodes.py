"""Two nodes of Ray on this machine, for tests: says where they are, ends with its standard input.

A line there adds another node, for one that was killed. Arguments are indices of GPUs, one for
each of the two; without any they have what Ray finds.

A process of its own, because Ray in the process of the tests would start threads and warn there.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

from ray.cluster_utils import Cluster

NODE = {"num_cpus": 2, "object_store_memory": 80 << 20, "include_dashboard": False}
QUICK = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 6,
}
"""So that a dead node is noticed in seconds."""


def main() -> None:
    """Starts them and waits."""
    first, other = ({**NODE, **_gpu(gpu)} for gpu in sys.argv[1:] or (None, None))
    cluster = Cluster(initialize_head=True, head_node_args={**first, "_system_config": QUICK})
    try:
        while True:
            second = cluster.add_node(**other)
            raylet = second.all_processes["raylet"][0].process.pid
            said = {"address": cluster.address, "second_raylet": raylet}
            sys.stdout.write(f"\n{json.dumps(said)}\n")
            sys.stdout.flush()
            if not sys.stdin.readline():
                break
    finally:
        for node in (*cluster.worker_nodes, cluster.head_node):
            # A test may have killed it.
            if node is not None:
                is_there = node.all_processes["raylet"][0].process.poll() is None
                cluster.remove_node(node, allow_graceful=is_there)


def _gpu(index: str | None) -> dict[str, Any]:
    if index is None:
        return {}
    return {"num_gpus": 1, "env_vars": {"CUDA_VISIBLE_DEVICES": index}}


if __name__ == "__main__":
    main()
