"""Keys that PPO and A3C share, with Brax's names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.algo import RolloutConfig, ValueNetwork
from gmijax.config.schema import doc
from gmijax.errors import ConfigError

ADAPTIVE_LEARNING_RATE_RANGE = (1e-5, 1e-2)
"""Where the adaptive schedule keeps the learning rate; that of rsl_rl (rl_games goes to 1e-6)."""


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(RolloutConfig):
    """Keys that PPO and A3C share."""

    gae_lambda: float = doc(
        "lambda of generalised advantage estimation (a3c: of V-trace's returns), 0 to 1",
        low=0.0,
        high=1.0,
    )
    normalize_advantage: bool = doc(
        "normalise advantages over all samples of all GMIs (a3c: over every batch)"
    )
    learning_rate_schedule: Literal["fixed", "adaptive_kl"] = doc(
        "fixed, or steered to keep the policy's KL divergence since the rollout (a3c: per batch) "
        "near desired_kl"
    )
    discounting: float = doc("discount factor per step, 0 to 1", low=0.0, high=1.0)
    value_cost: float = doc("weight of the value loss", low=0.0)
    entropy_cost: float = doc("weight of the entropy bonus", low=0.0)
    bound_cost: float = doc("weight of the penalty on action means outside [-1.1, 1.1]", low=0.0)
    desired_kl: float = doc("target of the adaptive schedule", positive=True)
    reward_scaling: float = doc(
        "factor on rewards before learning (logged returns are unscaled)", positive=True
    )
    normalize_values: bool = doc(
        "the value function learns its targets in standard deviations from their running mean; "
        "value_cost, and with PPO the clip of the value loss, count in this unit. When it moves, "
        "the last layer moves with it, so that values stay what they were",
        default=False,
    )
    value_obs_key: Literal["auto", "state", "privileged_state"] = doc(
        "the value function sees what the policy does (state), or also what the task has for it "
        "alone (privileged_state); auto: that, where there is any",
        default="auto",
    )
    value_hidden_layer_sizes: tuple[int, ...] = doc("widths of the value network", low=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = ADAPTIVE_LEARNING_RATE_RANGE
        if self.adaptive_kl is not None and not low <= self.learning_rate <= high:
            raise ConfigError(
                f"algo.learning_rate={self.learning_rate!r}: must be between {low} and {high} "
                "with algo.learning_rate_schedule=adaptive_kl"
            )

    @property
    def adaptive_kl(self) -> float | None:
        """See `PolicyConfig`."""
        return self.desired_kl if self.learning_rate_schedule == "adaptive_kl" else None

    @property
    def value_network(self) -> ValueNetwork:
        """See `PolicyConfig`."""
        sizes = self.value_hidden_layer_sizes
        return ValueNetwork(sizes, self.value_obs_key, self.normalize_values)
