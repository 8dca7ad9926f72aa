"""Hyper-parameters of PPO and A3C, with Brax's names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

ADAPTIVE_LEARNING_RATE_RANGE = (1e-5, 1e-2)
"""Where the adaptive schedule keeps the learning rate; that of rsl_rl (rl_games goes to 1e-6)."""


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(KeyGroup):
    """Keys that PPO and A3C share."""

    prefix = "algo."

    unroll_length: int = doc(
        "T, environment steps per environment and iteration (a3c: and unroll)", low=1
    )
    num_minibatches: int = doc("minibatches per pass over the rollout (a3c: a batch)", low=1)
    num_updates_per_batch: int = doc("passes over the rollout (a3c: a batch), epochs", low=1)
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
    learning_rate: float = doc(
        "step size of Adam (the first one, if the schedule is adaptive)", positive=True
    )
    desired_kl: float = doc("target of the adaptive schedule", positive=True)
    max_grad_norm: float = doc("gradients are scaled down to this global norm", positive=True)
    reward_scaling: float = doc(
        "factor on rewards before learning (logged returns are unscaled)", positive=True
    )
    normalize_observations: bool = doc("normalise observations with running statistics")
    normalize_values: bool = doc(
        "the value function learns its targets in standard deviations from their running mean; "
        "value_cost, and with PPO the clip of the value loss, count in this unit. When it moves, "
        "the last layer moves with it, so that values stay what they were",
        default=False,
    )
    obs_std_floor: float = doc(
        "smallest standard deviation that observations are divided by", default=1e-4, low=1e-4
    )
    preserve_outputs: bool = doc(
        "when the statistics of observations change, the first layers of both networks change "
        "with them, so that policy and values stay what they were",
        default=False,
    )
    value_obs_key: Literal["auto", "state", "privileged_state"] = doc(
        "the value function sees what the policy does (state), or also what the task has for it "
        "alone (privileged_state); auto: that, where there is any",
        default="auto",
    )
    policy_hidden_layer_sizes: tuple[int, ...] = doc("widths of the policy network", low=1)
    value_hidden_layer_sizes: tuple[int, ...] = doc("widths of the value network", low=1)
    precision: Literal["float32", "bfloat16"] = doc(
        "what the hidden layers of both networks compute in, for acting and learning; weights, "
        "output layers, losses and optimizer are float32",
        default="float32",
    )
    distribution_type: Literal["normal", "tanh_normal"] = doc(
        "actions are drawn from a Gaussian, which the environment clips to [-1, 1], or from the "
        "tanh of one",
        default="normal",
    )
    state_dependent_std: bool = doc(
        "the policy's network gives the standard deviation too; false: it is the same in all "
        "states",
        default=False,
    )
    init_noise_std: float = doc("standard deviation of the first policy", positive=True)
    init_at_random_ep_len: bool = doc(
        "cut the first episode of every environment at a random time, so that they do not go "
        "through their episodes in step; those episodes are not counted in returns",
        default=False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = ADAPTIVE_LEARNING_RATE_RANGE
        if self.learning_rate_schedule == "adaptive_kl" and not low <= self.learning_rate <= high:
            raise ConfigError(
                f"algo.learning_rate={self.learning_rate!r}: must be between {low} and {high} "
                "with algo.learning_rate_schedule=adaptive_kl"
            )

    @property
    def hidden_layer_sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of the policy and of the value network."""
        return self.policy_hidden_layer_sizes, self.value_hidden_layer_sizes


@dataclass(frozen=True, kw_only=True)
class PpoConfig(ActorCriticConfig):
    """Hyper-parameters of PPO, with Brax's names."""

    # algo= sets it.
    name: Literal["ppo"] = "ppo"
    clipping_epsilon: float = doc("clip range of the probability ratio", positive=True)
    clip_value_loss: bool = doc("clip the value loss with clipping_epsilon too")
    recompute_advantages: bool = doc(
        "compute values and advantages anew before every pass over the rollout, with the value "
        "function as it is by then; false: once for all passes",
        default=False,
    )
    obs_outliers: Literal["clip", "diverged"] = doc(
        "what does not enter the statistics of observations as it is: what is more than 20 "
        "standard deviations off is clipped to that (clip), or environments that diverge before "
        "the rollout or their episode ends are left out (diverged)",
        default="clip",
    )
    warmup_unroll: bool = doc(
        "begin with a rollout that only fills the statistics of observations; it is not learnt "
        "from and not counted",
        default=False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.warmup_unroll and not self.normalize_observations:
            raise ConfigError(
                "algo.warmup_unroll=true: has nothing to fill with "
                "algo.normalize_observations=false"
            )


@dataclass(frozen=True, kw_only=True)
class A3cConfig(ActorCriticConfig):
    """Hyper-parameters of asynchronous actor-critic training, with Brax's names."""

    # algo= sets it.
    name: Literal["a3c"] = "a3c"
    weights_every: int | None = doc(
        "environment steps after which, at the latest, an agent takes up newer weights, within an "
        "unroll too; null: with every unroll",
        low=1,
    )
    batch_size: int | None = doc(
        "B, unrolls in one batch of one trainer; null: num_envs, the unrolls of one agent", low=1
    )
    vtrace: bool = doc(
        "correct for the age of the policy that acted with V-trace; false: plain n-step returns"
    )
    rho_clip: float = doc("V-trace's upper limit of a step's probability ratio", positive=True)
    trace_clip: float = doc(
        "V-trace's upper limit of the ratio that lets later steps through", positive=True
    )
    clipping_epsilon: float | None = doc(
        "clip range of the probability ratio during the passes over a batch, as in PPO; null: the "
        "plain policy gradient of A3C",
        positive=True,
    )
    max_staleness: int | None = doc(
        "unrolls of a policy that is more versions behind are dropped; null: none are", low=1
    )
    max_ahead: int = doc(
        "unrolls of an agent that may wait for every trainer before the agent waits too",
        low=1,
    )

    @property
    def pieces_per_unroll(self) -> int:
        """In how many equal pieces an agent makes an unroll, each with the newest weights."""
        longest = min(self.weights_every or self.unroll_length, self.unroll_length)
        return next(
            pieces
            for pieces in range(-(-self.unroll_length // longest), self.unroll_length + 1)
            if self.unroll_length % pieces == 0
        )

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
