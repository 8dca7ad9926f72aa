"""The plan: all that is needed to launch a job, as pure data.

A plan is made by `gmijax.partition.planner` from the configuration and the machine, written to
`plan.json`, and never changed after that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

from gmijax.config import BackendName, TemplateName
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout

MAX_MEMORY_FRACTION = 0.9
"""Limit of the sum of memory fractions on one GPU: CUDA contexts, NCCL and Warp need the rest."""


@dataclass(frozen=True)
class Allocation:
    """What one GMI has of a GPU and of the CPU cores.

    Attributes:
      gmi: its id.
      gpu: position of its GPU in the job.
      device: what the GMI's process sees: the UUID of a GPU or of a MIG instance, or `cpu`.
      sm_percent: cap on SMs in percent, None for no cap.
      memory_fraction: fraction of the device's memory, None where memory is not partitioned.
      cpus: CPU cores that the process is pinned to; empty for no pinning.
    """

    gmi: int
    gpu: int
    device: str
    sm_percent: float | None
    memory_fraction: float | None
    cpus: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """All that is needed to launch a job.

    Attributes:
      layout: GPU -> GMIs.
      allocations: one per GMI, in order of id.
      backend: how shares are enforced.
      template: how roles map to GMIs.
      num_envs_per_gmi: N.
      strategy: gradient reduction, `none` for one GMI.
      intra: exchange inside one GPU.
      inter: exchange between nodes, `nccl` or `tcp`; None where those that train are on one.
      roles: what every GMI does, in order of id (see `gmijax.partition.templates`); none where
        that is classes of the user's own.
      reasons: what was decided for an `auto`, and why, one sentence each.
      self_check: every GMI compares matrix products with float64 when it starts.
      allow_fallback: where the daemons of `mps` cannot be started, backend `share` may be used.
      nodes: addresses of the nodes of the layout, in order; none in a job on one machine.

    Raises:
      ConfigError: allocations or roles that do not fit the layout, or memory fractions over the
        limit.
    """

    layout: Layout
    allocations: tuple[Allocation, ...]
    backend: BackendName
    template: TemplateName
    num_envs_per_gmi: int
    strategy: str
    intra: str
    roles: tuple[str, ...]
    reasons: tuple[str, ...] = ()
    self_check: bool = False
    allow_fallback: bool = False
    nodes: tuple[str, ...] = ()
    inter: str | None = None

    def __post_init__(self) -> None:
        if self.layout.num_nodes != max(1, len(self.nodes)):
            raise ConfigError(f"plan: nodes {self.nodes} do not match layout {self.layout}")
        if [s.gmi for s in self.allocations] != list(self.layout.gmis):
            raise ConfigError(
                f"plan: allocations {self.allocations} do not match layout {self.layout}"
            )
        if self.roles and len(self.roles) != self.layout.num_gmis:
            raise ConfigError(f"plan: roles {self.roles} do not match layout {self.layout}")
        # Two nodes of a cluster may be one machine, with one GPU.
        for device in dict.fromkeys(allocation.device for allocation in self.allocations):
            here = [allocation for allocation in self.allocations if allocation.device == device]
            total = sum(allocation.memory_fraction or 0.0 for allocation in here)
            if total > MAX_MEMORY_FRACTION + 1e-9:
                part = f"{device} of GPU" if self.backend == "mig" else "GPU"
                raise ConfigError(
                    f"plan.memory_fraction: {len(here)} GMIs on {part} {here[0].gpu} would "
                    f"reserve {total:.2f} of its memory; at most {MAX_MEMORY_FRACTION} in sum"
                )

    def to_dict(self) -> dict[str, Any]:
        """Plain data for `plan.json`."""
        data = asdict(self)
        data["layout"] = [list(gmis) for gmis in self.layout.gmis_of_gpu]
        data["nodes"] = self.nodes_data()
        return data

    def nodes_data(self) -> list[dict[str, Any]]:
        """Address and GMIs of every node; the index of a GMI in the list is its rank there."""
        pairs = zip(self.nodes, self.layout.gmis_of_node, strict=False)
        return [{"address": address, "gmis": list(gmis)} for address, gmis in pairs]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Plan:
        """Inverts `to_dict`, after a round trip through JSON too.

        Raises:
          ConfigError: it is not the data of a plan.
        """
        try:
            return cls._from_dict(data)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"not a plan ({type(error).__name__}: {error})") from None

    @classmethod
    def _from_dict(cls, data: Mapping[str, Any]) -> Plan:
        fields = {_FORMER.get(name, name): value for name, value in data.items()}
        fields.pop("selection", None)
        nodes = tuple(node["address"] for node in data.get("nodes", ()))
        rows = tuple(tuple(gmis) for gmis in data["layout"])
        fields["nodes"], fields["layout"] = nodes, Layout(rows, max(1, len(nodes)))
        fields["allocations"] = tuple(
            Allocation(**{**_without(item, "priority"), "cpus": tuple(item["cpus"])})
            for item in fields["allocations"]
        )
        fields["reasons"] = tuple(data["reasons"])
        fields["roles"] = tuple(data["roles"])
        return cls(**fields)


_FORMER: Mapping[str, str] = MappingProxyType(
    {"slices": "allocations", "may_share": "allow_fallback"}
)
"""What plans of older versions call a field."""


def _without(data: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Plain data without a key that plans of older versions have."""
    return {name: value for name, value in data.items() if name != key}
