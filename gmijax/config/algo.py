"""Keys that all algorithms have, and those of all that learn from rollouts; Brax's names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, Self

from gmijax.config.plan import PlanConfig
from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


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


class KeptReplay(NamedTuple):
    """The replay of an algorithm that has one.

    Attributes:
      steps: of every environment that it holds.
      starts: steps of every environment before the first update.
      is_saved: whether the checkpoint at the end of a run holds it.
      keys: on which it depends what is saved.
    """

    steps: int
    starts: int
    is_saved: bool
    keys: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(KeyGroup):
    """Keys of all algorithms: the length of rollouts, the policy, its optimiser."""

    prefix = "algo."
    implementation: ClassVar[str] = ""
    """`module:name` of the `gmijax.learning.algorithm.Algorithm`, where every GMI simulates, acts
    and trains; jax is imported with it."""
    fixed_keys: ClassVar[tuple[str, ...]] = ("activation", "state_dependent_std")
    """What a resumed run cannot change, since its weights depend on it."""
    small_keys: ClassVar[tuple[str, ...]] = ()
    """What a small try on a CPU changes, beside the numbers of environments and steps."""
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
    activation: Literal["elu", "layer_norm_silu"] = doc(
        "what comes behind the hidden layers of both networks: ELU, or layer norm and SiLU, as "
        "FastSAC has them",
        default="elu",
    )
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
    def kept_replay(self) -> KeptReplay | None:
        """The replay, if there is one."""
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

    @property
    def kept_key(self) -> str:
        """The key that says so."""
        return "algo.unroll_length"

    @property
    def kept_itemsize(self) -> int:
        """Bytes of each number of an observation or action of that."""
        return 4

    def with_checkpoints(self, find: Callable[[str, str], Path]) -> Self:
        """This configuration with what it takes from other runs as paths of checkpoints.

        `find` is given what the user wrote and the key, as `gmijax.runs.resume.find_checkpoint`.
        """
        del find
        return self

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """Checks what depends on other keys too; `num_envs` is None where it is not decided yet.

        Raises:
          ConfigError: environments per GMI do not divide into minibatches, or the like.
        """
        del num_envs, plan


@dataclass(frozen=True, kw_only=True)
class RolloutConfig(PolicyConfig):
    """Keys of algorithms that learn from every rollout in passes over it, and never again."""

    num_minibatches: int = doc("minibatches per pass over the rollout (a3c: a batch)", low=1)
    num_updates_per_batch: int = doc("passes over the rollout (a3c: a batch), epochs", low=1)

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """See `PolicyConfig`."""
        del plan
        samples = (num_envs or 0) * self.unroll_length
        if samples % self.num_minibatches:
            raise ConfigError(
                f"num_envs={num_envs}: num_envs x algo.unroll_length = {samples} samples "
                f"do not divide into algo.num_minibatches={self.num_minibatches} minibatches"
            )
