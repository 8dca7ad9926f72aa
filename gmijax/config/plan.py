"""How a job is spread over GPUs, and how its gradients are averaged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc, require_at_least
from gmijax.errors import ConfigError

BackendName = Literal["mps", "mig", "share", "cpu"]
StrategyName = Literal["mpr", "mrr", "har", "flat", "one_shot"]
TemplateName = Literal["tcg", "tdg", "tcg_ex", "tdg_ex", "decoupled"]

MAX_GMIS = 1024
"""More processes than one host can run; making a plan of far more would take all its memory."""


def require_gpus(key: str, gpus: int | tuple[int, ...]) -> None:
    """Raises ConfigError unless it is a number of GPUs, or distinct indices."""
    if isinstance(gpus, int):
        require_at_least(key, gpus, 1)
    elif not gpus or len(set(gpus)) != len(gpus) or min(gpus) < 0:
        raise ConfigError(f"{key}={list(gpus)}: expected a number of GPUs or distinct indices")


@dataclass(frozen=True, kw_only=True)
class PlanConfig(KeyGroup):
    """How the job is spread over GPUs."""

    prefix = "plan."

    gpus: int | tuple[int, ...] = doc(
        "number of GPUs, or their indices as nvidia-smi lists them", default=1
    )
    gmis_per_gpu: int | Literal["auto"] = doc(
        "GMIs on every GPU; auto: the number that a search finds (docs/search.md). With algo=a3c "
        "leave it at 1 and use plan.serving_gmis_per_gpu and plan.training_gmis_per_gpu",
        default=1,
        low=1,
    )
    layout: tuple[tuple[int, ...], ...] | None = doc(
        "GMI ids of every GPU, e.g. [[0,1],[2]]; overrides gpus and gmis_per_gpu", default=None
    )
    backend: Literal["auto", BackendName] = doc(
        "how a GMI gets its share of a GPU", default="auto"
    )
    sm_percent: float | tuple[float, ...] | Literal["even"] | None = doc(
        "cap on a GMI's share of SMs in percent (MPS): one number, one per GMI, even (100 / GMIs "
        "of the GPU, kept clear of docs/shares.md's bad values), or null: no cap",
        default=None,
        low=1.0,
        high=100.0,
    )
    memory_fraction: float | tuple[float, ...] | None = doc(
        "fraction of a GPU's (or MIG instance's) memory that each GMI reserves: one number or one "
        "per GMI; null: 0.8 split evenly",
        default=None,
        low=0.01,
        high=1.0,
    )
    template: Literal["auto", TemplateName] = doc("how roles map to GMIs", default="auto")
    self_check: Literal["auto", "on", "off"] = doc(
        "compare matrix products with float64 when a GMI starts; auto: where SMs are capped, or "
        "an MPS daemon that gmijax did not start may cap them",
        default="auto",
    )
    serving_gpus: int | tuple[int, ...] | None = doc(
        "with algo=a3c: number of GPUs that act, or their indices; null: all but the training "
        "ones, or the only one",
        default=None,
    )
    training_gpus: int | tuple[int, ...] | None = doc(
        "with algo=a3c: number of GPUs that train, or their indices (a GPU may do both); null: "
        "the last quarter, at least one",
        default=None,
    )
    serving_gmis_per_gpu: int | None = doc(
        "with algo=a3c: acting GMIs on every GPU that acts; null: 1", default=None
    )
    training_gmis_per_gpu: int = doc(
        "with algo=a3c: training GMIs on every GPU that trains", default=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_gpus("plan.gpus", self.gpus)
        self._require_few_gmis()

    def _require_few_gmis(self) -> None:
        for side in ("", "serving_", "training_"):
            gpus = getattr(self, f"{side}gpus")
            gpus = self.gpus if gpus is None else gpus
            num_gpus = gpus if isinstance(gpus, int) else len(gpus)
            key = f"{side}gmis_per_gpu"
            gmis = self.num_serving_gmis if side == "serving_" else getattr(self, key)
            if (num_gmis := num_gpus * (1 if gmis == "auto" else gmis)) > MAX_GMIS:
                raise ConfigError(
                    f"plan.{key}={gmis}: makes {num_gmis} GMIs on {num_gpus} GPUs; at most "
                    f"{MAX_GMIS} are allowed"
                )

    @property
    def num_serving_gmis(self) -> int:
        """Acting GMIs on every GPU that acts."""
        return 1 if self.serving_gmis_per_gpu is None else self.serving_gmis_per_gpu

    @property
    def num_gpus(self) -> int:
        """GPUs of the whole job."""
        if self.layout is not None:
            return len(self.layout)
        return self.gpus if isinstance(self.gpus, int) else len(self.gpus)

    def require_template(self, allowed: Iterable[TemplateName], why: str) -> None:
        """Raises ConfigError unless `template` is `auto` or one of those `allowed`."""
        names = ("auto", *allowed)
        if self.template not in names:
            raise ConfigError(
                f"plan.template={self.template}: not for {why}; allowed: {', '.join(names)}"
            )


@dataclass(frozen=True, kw_only=True)
class ReduceConfig(KeyGroup):
    """How gradients are averaged over GMIs."""

    prefix = "reduce."

    strategy: Literal["auto", "paper", StrategyName] = doc(
        "reduction strategy; auto: by the layout, one_shot where several GMIs share a GPU and can "
        "map its memory; paper: by the layout alone, the paper's Algorithm 1",
        default="auto",
    )
    timeout_s: float = doc(
        "longest wait for another GMI in one exchange, seconds", default=120.0, positive=True
    )
