"""How a job is spread over GPUs, and how its gradients are averaged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.errors import ConfigError
from gmijax.schema import doc, require_at_least, require_between, require_positive


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How the job is spread over GPUs."""

    gpus: int | tuple[int, ...] = doc("number of GPUs, or their indices as nvidia-smi lists them")
    gmis_per_gpu: int = doc("GMIs on every GPU")
    layout: tuple[tuple[int, ...], ...] | None = doc(
        "GMI ids of every GPU, e.g. [[0,1],[2]]; overrides gpus and gmis_per_gpu"
    )
    backend: Literal["auto", "mps", "mig", "share", "cpu"] = doc(
        "how a GMI gets its share of a GPU"
    )
    sm_percent: float | None = doc("cap on a GMI's share of SMs in percent (MPS); null: no cap")
    memory_fraction: float | None = doc(
        "fraction of a GPU's memory that each GMI reserves; null: 0.8 split evenly"
    )
    template: Literal["auto", "tcg_ex"] = doc("how roles map to GMIs")

    def __post_init__(self) -> None:
        if isinstance(self.gpus, int):
            require_at_least("plan.gpus", self.gpus, 1)
        elif not self.gpus or len(set(self.gpus)) != len(self.gpus) or min(self.gpus) < 0:
            raise ConfigError(
                f"plan.gpus={list(self.gpus)}: expected a number of GPUs or distinct indices"
            )
        require_at_least("plan.gmis_per_gpu", self.gmis_per_gpu, 1)
        if self.sm_percent is not None:
            require_between("plan.sm_percent", self.sm_percent, 1.0, 100.0)
        if self.memory_fraction is not None:
            require_between("plan.memory_fraction", self.memory_fraction, 0.01, 1.0)


@dataclass(frozen=True, kw_only=True)
class ReduceConfig:
    """How gradients are averaged over GMIs."""

    strategy: Literal["auto", "mpr", "mrr", "har", "flat"] = doc(
        "reduction strategy; auto: by the layout (Algorithm 1 of the paper)"
    )
    intra: Literal["auto", "host", "ipc"] = doc("exchange inside one GPU, for har; auto: host")
    timeout_s: float = doc("longest wait for another GMI in one exchange, seconds")

    def __post_init__(self) -> None:
        require_positive("reduce.timeout_s", self.timeout_s)
