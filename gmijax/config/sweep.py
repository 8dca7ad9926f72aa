"""What sweeps and packs share, and all keys of `python -m gmijax.sweep`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from gmijax.config.plan import require_gpus
from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


class Ranking(Protocol):
    """What jobs are compared by."""

    @property
    def objective(self) -> str:
        """A key of their lines of metrics."""
        ...

    @property
    def direction(self) -> Literal["maximize", "minimize"]:
        """Whether a larger or a smaller one is better."""
        ...


@dataclass(frozen=True, kw_only=True)
class JobsConfig(KeyGroup):
    """How many jobs share the GPUs, and where they come from."""

    gpus: int | tuple[int, ...] | None = doc(
        "number of GPUs, or their indices as nvidia-smi lists them; null: all", default=None
    )
    jobs_per_gpu: int | Literal["auto"] = doc(
        "jobs that run at the same time on every GPU (without one: on the machine); auto: the "
        "number that makes the most steps, which is measured",
        default="auto",
        low=1,
    )
    direction: Literal["maximize", "minimize"] = doc(
        "whether a larger or a smaller objective is better", default="maximize"
    )
    sampler: Literal["grid", "random", "tpe"] = doc(
        "where jobs come from: every combination of the lists (grid), or draws from lists and "
        "intervals by Optuna (random, tpe)",
        default="grid",
    )
    trials: int | None = doc("number of jobs with another sampler than grid", default=None, low=1)
    pruner: Literal["none", "asha", "median"] = doc(
        "ends jobs early that are worse than others were (Optuna); not with the sampler grid",
        default="none",
    )
    seed: int = doc("seed of the sampler", default=0, low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_sampler()
        if self.gpus is not None:
            require_gpus(f"{self.prefix}gpus", self.gpus)

    def _require_sampler(self) -> None:
        key = self.prefix
        if self.sampler != "grid" and self.trials is None:
            raise ConfigError(f"{key}sampler={self.sampler}: needs {key}trials, how many jobs")
        if self.sampler == "grid" and self.trials is not None:
            raise ConfigError(f"{key}trials={self.trials}: {key}sampler=grid runs all of them")
        if self.sampler == "grid" and self.pruner != "none":
            raise ConfigError(
                f"{key}pruner={self.pruner}: not with {key}sampler=grid; allowed: random, tpe"
            )


@dataclass(frozen=True, kw_only=True)
class SweepConfig(JobsConfig):
    """How the jobs of a sweep share the GPUs, and what they are compared by."""

    prefix = "sweep."

    pack: Literal["gmi", "vmap", "auto"] = doc(
        "how jobs share a GPU: each in processes of its own (gmi), those that differ in seed and "
        "learning rate alone as one program (vmap; only with sampler=grid), or as one where "
        "possible (auto; with another sampler as gmi)",
        default="gmi",
    )
    objective: str = doc(
        "what jobs are ranked by: a key of their metrics. Means over episodes count at the end of "
        "a job, evaluations at their best; auto: eval/return if all jobs have eval.every, else "
        "return",
        default="auto",
    )

    @property
    def may_share_programs(self) -> bool:
        """Whether jobs may be one program.

        Not those of a sampler: it hands them out one at a time, and a pruner ends each for itself.
        """
        return self.pack != "gmi" and self.sampler == "grid"

    def _require_sampler(self) -> None:
        super()._require_sampler()
        if self.sampler != "grid" and self.pack == "vmap":
            raise ConfigError("sweep.pack=vmap: only with sweep.sampler=grid; use gmi")
