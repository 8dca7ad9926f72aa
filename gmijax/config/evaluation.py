"""Evaluation while training."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.config.schema import KeyGroup, doc


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
