"""Hyper-parameters of A3C, and how its experience travels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.ppo import ADAPTIVE_LEARNING_RATE_RANGE
from gmijax.errors import ConfigError
from gmijax.schema import doc, require_at_least, require_between, require_positive


@dataclass(frozen=True, kw_only=True)
class A3cConfig:
    """Hyper-parameters of asynchronous actor-critic training, with Brax's names."""

    name: Literal["a3c"] = doc("training algorithm")
    unroll_length: int = doc("T, environment steps per environment and unroll")
    batch_size: int | None = doc(
        "B, unrolls in one batch of one trainer; null: num_envs, the unrolls of one agent"
    )
    num_minibatches: int = doc("minibatches per pass over a batch")
    num_updates_per_batch: int = doc("passes over a batch (epochs)")
    discounting: float = doc("discount factor per step, 0 to 1")
    vtrace: bool = doc(
        "correct for the age of the policy that acted with V-trace; false: plain n-step returns"
    )
    gae_lambda: float = doc("lambda of V-trace's returns, 0 to 1")
    rho_clip: float = doc("V-trace's upper limit of a step's probability ratio")
    trace_clip: float = doc("V-trace's upper limit of the ratio that lets later steps through")
    clipping_epsilon: float | None = doc(
        "clip range of the probability ratio during the passes over a batch, as in PPO; null: the "
        "plain policy gradient of A3C"
    )
    max_staleness: int | None = doc(
        "unrolls of a policy that is more versions behind are dropped; null: none are"
    )
    max_ahead: int = doc(
        "unrolls of an agent that may wait for every trainer before the agent waits too "
        "(channel.when_full=block)"
    )
    value_cost: float = doc("weight of the value loss")
    entropy_cost: float = doc("weight of the entropy bonus")
    bound_cost: float = doc("weight of the penalty on action means outside [-1.1, 1.1]")
    learning_rate: float = doc("step size of Adam (the first one, if the schedule is adaptive)")
    learning_rate_schedule: Literal["fixed", "adaptive_kl"] = doc(
        "fixed, or steered to keep the policy's KL divergence per batch near desired_kl"
    )
    desired_kl: float = doc("target of the adaptive schedule")
    max_grad_norm: float = doc("gradients are scaled down to this global norm")
    reward_scaling: float = doc("factor on rewards before learning (logged returns are unscaled)")
    normalize_observations: bool = doc("normalise observations with running statistics")
    normalize_advantage: bool = doc("normalise advantages over every batch")
    policy_hidden_layer_sizes: tuple[int, ...] = doc("widths of the policy network")
    value_hidden_layer_sizes: tuple[int, ...] = doc("widths of the value network")
    init_noise_std: float = doc("standard deviation of the first policy")

    def __post_init__(self) -> None:
        for key in ("unroll_length", "num_minibatches", "num_updates_per_batch", "max_ahead"):
            require_at_least(f"algo.{key}", getattr(self, key), 1)
        for key in ("discounting", "gae_lambda"):
            require_between(f"algo.{key}", getattr(self, key), 0.0, 1.0)
        for key in ("value_cost", "entropy_cost", "bound_cost"):
            require_at_least(f"algo.{key}", getattr(self, key), 0.0)
        for key in (
            *("rho_clip", "trace_clip", "learning_rate", "desired_kl", "max_grad_norm"),
            *("reward_scaling", "init_noise_std"),
        ):
            require_positive(f"algo.{key}", getattr(self, key))
        for key in ("policy_hidden_layer_sizes", "value_hidden_layer_sizes"):
            for width in getattr(self, key):
                require_at_least(f"algo.{key}", width, 1)
        self._check_optional()

    def batch_of(self, num_envs: int) -> int:
        """B with `num_envs` environments on every agent.

        Raises:
          ConfigError: unrolls of an agent and of a batch do not fit into each other, or a batch
            not into minibatches.
        """
        batch = self.batch_size or num_envs
        if batch % num_envs and num_envs % batch:
            raise ConfigError(
                f"algo.batch_size={batch}: must be a multiple or a divisor of num_envs={num_envs}"
            )
        if batch % self.num_minibatches:
            raise ConfigError(
                f"algo.num_minibatches={self.num_minibatches}: must divide the {batch} unrolls "
                "of a batch (algo.batch_size, or num_envs if that is null)"
            )
        return batch

    def _check_optional(self) -> None:
        if self.batch_size is not None:
            require_at_least("algo.batch_size", self.batch_size, 1)
        if self.max_staleness is not None:
            require_at_least("algo.max_staleness", self.max_staleness, 1)
        if self.clipping_epsilon is not None:
            require_positive("algo.clipping_epsilon", self.clipping_epsilon)
        low, high = ADAPTIVE_LEARNING_RATE_RANGE
        if self.learning_rate_schedule == "adaptive_kl" and not low <= self.learning_rate <= high:
            raise ConfigError(
                f"algo.learning_rate={self.learning_rate!r}: must be between {low} and {high} "
                "with algo.learning_rate_schedule=adaptive_kl"
            )
