"""Keys of distillation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from gmijax.config.algo import RolloutConfig
from gmijax.config.plan import PlanConfig
from gmijax.config.schema import doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class DistillConfig(RolloutConfig):
    """Hyper-parameters of distillation: a student learns to act as a trained policy does."""

    implementation = "gmijax.distill.distill:DISTILL"

    # algo= sets it.
    name: Literal["distill"] = "distill"
    teacher: str | None = doc(
        "run folder or checkpoint of the policy that the student learns from, trained on a task "
        "with the same observations and actions; last: the newest run"
    )

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """See `PolicyConfig`."""
        if self.teacher is None:
            raise ConfigError(
                "algo.teacher=null: algo=distill learns from a trained policy; expected its run "
                "folder or checkpoint"
            )
        super().check_job(num_envs, plan)

    def with_checkpoints(self, find: Callable[[str, str], Path]) -> Self:
        """See `PolicyConfig`."""
        assert self.teacher is not None
        return dataclasses.replace(self, teacher=str(find(self.teacher, "algo.teacher")))
