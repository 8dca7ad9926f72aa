"""Everything that `python -m gmijax.sweep` can be told beside the training jobs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.plan import require_gpus
from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class SweepConfig(KeyGroup):
    """How the jobs of a sweep share the GPUs, and what they are compared by."""

    prefix = "sweep."

    gpus: int | tuple[int, ...] | None = doc(
        "number of GPUs, or their indices as nvidia-smi lists them; null: all", default=None
    )
    jobs_per_gpu: int | Literal["auto"] = doc(
        "jobs that run at the same time on every GPU (without one: on the machine); auto: as many "
        "as make the most steps, by profiling",
        default="auto",
        low=1,
    )
    pack: Literal["gmi", "vmap", "auto"] = doc(
        "how jobs share a GPU: each in processes of its own (gmi), those that differ in seed and "
        "learning rate alone as one program (vmap; only with sampler=grid), or so where they can "
        "(auto)",
        default="gmi",
    )
    objective: str = doc(
        "what jobs are ranked by: a key of their metrics, of means over episodes at the end of a "
        "job, of evaluations the best; auto: eval/return if all jobs have eval.every, else return",
        default="auto",
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
        "ends jobs early that are worse than others were (Optuna); not with sampler=grid",
        default="none",
    )
    seed: int = doc("of the sampler", default=0, low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_sampler()
        if self.gpus is not None:
            require_gpus("sweep.gpus", self.gpus)

    def _require_sampler(self) -> None:
        if self.sampler != "grid" and self.trials is None:
            raise ConfigError(f"sweep.sampler={self.sampler}: needs sweep.trials, how many jobs")
        if self.sampler == "grid" and self.trials is not None:
            raise ConfigError(f"sweep.trials={self.trials}: sweep.sampler=grid runs all of them")
        if self.sampler == "grid" and self.pruner != "none":
            raise ConfigError(
                f"sweep.pruner={self.pruner}: not with sweep.sampler=grid; allowed are random, tpe"
            )
        if self.sampler != "grid" and self.pack == "vmap":
            raise ConfigError("sweep.pack=vmap: only with sweep.sampler=grid; use gmi")
