"""A job on several machines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class ClusterConfig(KeyGroup):
    """A job on several machines."""

    prefix = "cluster."

    engine: Literal["ray"] | None = doc(
        "what starts a job on several nodes, each with the GPUs and GMIs that plan says "
        "(docs/several-hosts.md); null: the job runs on this machine",
        default=None,
    )
    address: str = doc(
        "address of the Ray cluster: auto (RAY_ADDRESS, or the cluster that runs here), "
        "host:port, or local (a cluster for this job on this machine alone)",
        default="auto",
    )
    nodes: int | Literal["auto"] = doc(
        "number of nodes; auto: all with the CPUs and GPUs, not with algo=a3c",
        default="auto",
        low=1,
    )
    interface: str | None = doc(
        "network interface of the exchange between nodes, e.g. eth1; null: that of the address by "
        "which Ray knows a node",
        default=None,
    )
    wait_s: float = doc(
        "longest wait for nodes, at the start and after one was lost, seconds",
        default=60.0,
        low=0.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address.startswith("ray://"):
            raise ConfigError(
                f"cluster.address={self.address}: a job must be started on a node of the cluster, "
                "for example by `ray job submit`; allowed: auto, local, host:port"
            )
