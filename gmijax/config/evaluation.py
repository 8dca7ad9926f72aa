"""Evaluation while training."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class EvalConfig(KeyGroup):
    """Whole episodes with the policy as it is, now and then while it is trained."""

    prefix = "eval."

    every: int | None = doc(
        "environment steps of the whole job from one evaluation to the next, and one at the end; "
        "null: none",
        low=1,
    )
    episodes: int = doc("how many episodes an evaluation has, over all GMIs that train", low=1)
    deterministic: bool = doc("act with the policy's mean; false: sample actions")
    video: bool | int = doc(
        "film an episode of every evaluation (true), or of every n-th and the one at the end (n)",
        default=False,
        low=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.video and self.every is None:
            raise ConfigError(
                f"eval.video={self.video}: films evaluations, and there are none; give "
                "eval.every, environment steps between them"
            )
