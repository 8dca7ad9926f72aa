"""Hyper-parameters of PPO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.actor_critic import ActorCriticConfig
from gmijax.schema import doc, require_positive


@dataclass(frozen=True, kw_only=True)
class PpoConfig(ActorCriticConfig):
    """Hyper-parameters of PPO, with Brax's names."""

    name: Literal["ppo"] = doc("training algorithm")
    unroll_length: int = doc("T, environment steps per environment and iteration")
    num_minibatches: int = doc("minibatches per pass over the rollout")
    num_updates_per_batch: int = doc("passes over the rollout (epochs)")
    gae_lambda: float = doc("lambda of generalised advantage estimation, 0 to 1")
    clipping_epsilon: float = doc("clip range of the probability ratio")
    clip_value_loss: bool = doc("clip the value loss with clipping_epsilon too")
    learning_rate_schedule: Literal["fixed", "adaptive_kl"] = doc(
        "fixed, or steered to keep the policy's KL divergence per update near desired_kl"
    )
    normalize_advantage: bool = doc("normalise advantages over all samples of all GMIs")

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("algo.clipping_epsilon", self.clipping_epsilon)
