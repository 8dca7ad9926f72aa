"""Hyper-parameters of the algorithms, with Brax's names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, Self

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

ADAPTIVE_LEARNING_RATE_RANGE = (1e-5, 1e-2)
"""Where the adaptive schedule keeps the learning rate; that of rsl_rl (rl_games goes to 1e-6)."""


class ValueNetwork(NamedTuple):
    """The value function of an algorithm that has one.

    Attributes:
      hidden_layer_sizes: widths of its network.
      obs_key: see `ActorCriticConfig.value_obs_key`.
      is_normalized: see `ActorCriticConfig.normalize_values`.
    """

    hidden_layer_sizes: tuple[int, ...]
    obs_key: str
    is_normalized: bool


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(KeyGroup):
    """Keys of all algorithms: the length of rollouts, the policy, its optimiser."""

    prefix = "algo."
    implementation: ClassVar[str] = ""
    """`module:name` of the `gmijax.learning.algorithm.Algorithm`, where every GMI simulates, acts
    and trains; jax is imported with it."""
    templates: ClassVar[tuple[Literal["tcg_ex", "tdg_ex", "decoupled"], ...]] = ("tcg_ex",)
    """Which GMIs have which role (`gmijax.partition.templates`), the first one by default."""

    unroll_length: int = doc(
        "T, environment steps per environment and iteration (a3c: and unroll)", low=1
    )
    learning_rate: float = doc(
        "step size of Adam (the first one, if the schedule is adaptive)", positive=True
    )
    max_grad_norm: float = doc("gradients are scaled down to this global norm", positive=True)
    normalize_observations: bool = doc("normalise observations with running statistics")
    obs_std_floor: float = doc(
        "smallest standard deviation that observations are divided by", default=1e-4, low=1e-4
    )
    preserve_outputs: bool = doc(
        "when the statistics of observations change, the first layers of both networks change "
        "with them, so that policy and values stay what they were",
        default=False,
    )
    policy_hidden_layer_sizes: tuple[int, ...] = doc("widths of the policy network", low=1)
    policy_obs_key: Literal["auto", "state", "privileged_state"] = doc(
        "the policy sees what the task has for it (state), or also what the task has for the "
        "value function alone (privileged_state), as a teacher of algo=distill may; auto: state",
        default="auto",
    )
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

    @property
    def warms_up(self) -> bool:
        """Whether a run begins with an iteration that only fills the statistics."""
        return False

    @property
    def adaptive_kl(self) -> float | None:
        """The divergence that the learning rate is steered to; None where the rate is fixed."""
        return None

    @property
    def value_network(self) -> ValueNetwork | None:
        """The value function, if there is one."""
        return None

    @property
    def hidden_layer_sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of the policy and of the value network; empty where there is none."""
        value = self.value_network
        return self.policy_hidden_layer_sizes, value.hidden_layer_sizes if value else ()

    @property
    def kept_steps(self) -> int:
        """Steps of every environment whose experience is in memory at once."""
        return self.unroll_length

    def with_checkpoints(self, find: Callable[[str, str], Path]) -> Self:
        """This configuration with what it takes from other runs as paths of checkpoints.

        `find` is given what the user wrote and the key: `gmijax.runs.resume.find_checkpoint`.
        """
        del find
        return self

    def check_job(self, num_envs: int | None, template: str) -> None:
        """Checks what depends on other keys too; `num_envs` is None where it is not decided yet.

        Raises:
          ConfigError: environments per GMI do not divide into minibatches, or the like.
        """
        del num_envs, template


@dataclass(frozen=True, kw_only=True)
class RolloutConfig(PolicyConfig):
    """Keys of algorithms that learn from every rollout in passes over it, and never again."""

    num_minibatches: int = doc("minibatches per pass over the rollout (a3c: a batch)", low=1)
    num_updates_per_batch: int = doc("passes over the rollout (a3c: a batch), epochs", low=1)

    def check_job(self, num_envs: int | None, template: str) -> None:
        """See `PolicyConfig`."""
        del template
        samples = (num_envs or 0) * self.unroll_length
        if samples % self.num_minibatches:
            raise ConfigError(
                f"num_envs={num_envs}: num_envs x algo.unroll_length = {samples} samples "
                f"do not divide into algo.num_minibatches={self.num_minibatches} minibatches"
            )


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


@dataclass(frozen=True, kw_only=True)
class PpoConfig(ActorCriticConfig):
    """Hyper-parameters of PPO, with Brax's names."""

    implementation = "gmijax.ppo.ppo:PPO"
    templates = ("tcg_ex", "tdg_ex")

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

    @property
    def warms_up(self) -> bool:
        """See `PolicyConfig`."""
        return self.warmup_unroll

    def check_job(self, num_envs: int | None, template: str) -> None:
        """See `PolicyConfig`."""
        if self.recompute_advantages and template == "tdg_ex":
            raise ConfigError(
                "algo.recompute_advantages=true: for jobs in which every GMI trains; with "
                "plan.template=tdg_ex allowed is false"
            )
        super().check_job(num_envs, template)


@dataclass(frozen=True, kw_only=True)
class A3cConfig(ActorCriticConfig):
    """Hyper-parameters of asynchronous actor-critic training, with Brax's names."""

    templates = ("decoupled",)

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

    def check_job(self, num_envs: int | None, template: str) -> None:
        """See `PolicyConfig`."""
        del template
        if num_envs is not None:
            self.batch_of(num_envs)

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

    def check_job(self, num_envs: int | None, template: str) -> None:
        """See `PolicyConfig`."""
        if self.teacher is None:
            raise ConfigError(
                "algo.teacher=null: algo=distill learns from a trained policy; expected its run "
                "folder or checkpoint"
            )
        super().check_job(num_envs, template)

    def with_checkpoints(self, find: Callable[[str, str], Path]) -> Self:
        """See `PolicyConfig`."""
        assert self.teacher is not None
        return dataclasses.replace(self, teacher=str(find(self.teacher, "algo.teacher")))


_WIDEST_STD = 0.479
"""Entropy behind a tanh is at most 0.684 nats an action, that of a Gaussian this wide."""


@dataclass(frozen=True, kw_only=True)
class SacConfig(PolicyConfig):
    """Hyper-parameters of SAC with many environments and large batches (arXiv:2512.01996)."""

    implementation = "gmijax.sac.sac:SAC"

    # algo= sets it.
    name: Literal["sac"] = "sac"
    discounting: float = doc("discount factor per step, 0 to 1", low=0.0, high=1.0)
    reward_scaling: float = doc(
        "factor on rewards before learning (logged returns are unscaled)", positive=True
    )
    batch_size: int = doc("transitions in one update of one GMI, drawn from its replay", low=1)
    updates_per_step: int = doc(
        "updates of the critics after every step of all environments of a GMI", low=1
    )
    policy_every: int = doc("updates of the critics for every one of the policy", low=1)
    replay_steps: int = doc(
        "steps of every environment that the replay holds, a multiple of unroll_length", low=2
    )
    learning_starts: int = doc(
        "steps of every environment before the first update, also after a resume", low=2
    )
    critic_hidden_layer_sizes: tuple[int, ...] = doc("widths of each of the two critics", low=1)
    num_atoms: int = doc("atoms of the distribution of returns", low=2)
    value_range: float = doc(
        "discounted sums of scaled rewards that the critics know reach from minus this to this",
        positive=True,
    )
    target_rate: float = doc(
        "share of the way that target critics go to the critics with every update", positive=True
    )
    target_std: float = doc(
        "the temperature is steered to the entropy of a Gaussian with this standard deviation of "
        "every action in [-1, 1]",
        positive=True,
    )
    init_temperature: float = doc("weight of the entropy at first", positive=True)

    @property
    def kept_steps(self) -> int:
        """See `PolicyConfig`."""
        return self.replay_steps

    def check_job(self, num_envs: int | None, template: str) -> None:
        """See `PolicyConfig`."""
        fewest = (num_envs or self.batch_size) * self.learning_starts
        for key, value, wrong, allowed in (
            (
                *("replay_steps", self.replay_steps),
                self.replay_steps % self.unroll_length,
                f"a multiple of algo.unroll_length={self.unroll_length}",
            ),
            (
                *("learning_starts", self.learning_starts),
                self.learning_starts > self.replay_steps,
                f"at most algo.replay_steps={self.replay_steps}",
            ),
            (
                *("target_std", self.target_std),
                self.target_std > _WIDEST_STD,
                f"at most {_WIDEST_STD}: a distribution of actions in [-1, 1] has no more entropy",
            ),
            (
                *("distribution_type", self.distribution_type),
                self.distribution_type != "tanh_normal",
                "tanh_normal",
            ),
            ("preserve_outputs", self.preserve_outputs, self.preserve_outputs, "false"),
            ("target_rate", self.target_rate, self.target_rate > 1.0, "at most 1"),
            (
                *("batch_size", self.batch_size),
                self.batch_size > fewest,
                f"at most num_envs x algo.learning_starts = {fewest}",
            ),
        ):
            if wrong:
                raise ConfigError(f"algo.{key}={value}: with algo=sac must be {allowed}")
