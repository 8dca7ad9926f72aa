"""Hyper-parameters that both training algorithms have, with Brax's names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.errors import ConfigError
from gmijax.schema import doc, require_at_least, require_between, require_positive

ADAPTIVE_LEARNING_RATE_RANGE = (1e-5, 1e-2)
"""Where the adaptive schedule keeps the learning rate, and so where it must begin."""


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig:
    """What PPO and A3C share; some keys mean a little else to each, and are told there."""

    unroll_length: int
    num_minibatches: int
    num_updates_per_batch: int
    gae_lambda: float
    normalize_advantage: bool
    learning_rate_schedule: Literal["fixed", "adaptive_kl"]
    discounting: float = doc("discount factor per step, 0 to 1")
    value_cost: float = doc("weight of the value loss")
    entropy_cost: float = doc("weight of the entropy bonus")
    bound_cost: float = doc("weight of the penalty on action means outside [-1.1, 1.1]")
    learning_rate: float = doc("step size of Adam (the first one, if the schedule is adaptive)")
    desired_kl: float = doc("target of the adaptive schedule")
    max_grad_norm: float = doc("gradients are scaled down to this global norm")
    reward_scaling: float = doc("factor on rewards before learning (logged returns are unscaled)")
    normalize_observations: bool = doc("normalise observations with running statistics")
    policy_hidden_layer_sizes: tuple[int, ...] = doc("widths of the policy network")
    value_hidden_layer_sizes: tuple[int, ...] = doc("widths of the value network")
    init_noise_std: float = doc("standard deviation of the first policy")
    init_at_random_ep_len: bool = doc(
        "cut the first episode of every world at a random time, so that worlds do not go through "
        "their episodes in step; those episodes are not counted in returns",
        default=False,
    )

    def __post_init__(self) -> None:
        for key in ("unroll_length", "num_minibatches", "num_updates_per_batch"):
            require_at_least(f"algo.{key}", getattr(self, key), 1)
        for key in ("discounting", "gae_lambda"):
            require_between(f"algo.{key}", getattr(self, key), 0.0, 1.0)
        for key in ("value_cost", "entropy_cost", "bound_cost"):
            require_at_least(f"algo.{key}", getattr(self, key), 0.0)
        for key in (
            *("learning_rate", "desired_kl", "max_grad_norm"),
            *("reward_scaling", "init_noise_std"),
        ):
            require_positive(f"algo.{key}", getattr(self, key))
        for key in ("policy_hidden_layer_sizes", "value_hidden_layer_sizes"):
            for width in getattr(self, key):
                require_at_least(f"algo.{key}", width, 1)
        low, high = ADAPTIVE_LEARNING_RATE_RANGE
        if self.learning_rate_schedule == "adaptive_kl" and not low <= self.learning_rate <= high:
            raise ConfigError(
                f"algo.learning_rate={self.learning_rate!r}: must be between {low} and {high} "
                "with algo.learning_rate_schedule=adaptive_kl"
            )
