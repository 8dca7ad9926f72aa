"""Keys of SAC."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from gmijax.config.algo import KeptReplay, PolicyConfig
from gmijax.config.plan import PlanConfig
from gmijax.config.schema import doc
from gmijax.errors import ConfigError

_WIDEST_STD = 0.479
"""Entropy behind a tanh is at most 0.684 nats an action, that of a Gaussian this wide."""


@dataclass(frozen=True, kw_only=True)
class SacConfig(PolicyConfig):
    """Hyper-parameters of SAC with many environments and large batches (arXiv:2512.01996)."""

    implementation = "gmijax.sac.sac:SAC"
    fixed_keys = (
        *PolicyConfig.fixed_keys,
        *("critic_hidden_layer_sizes", "num_atoms", "value_range"),
    )
    # Updates cost by their batches, not by the number of environments.
    small_keys = ("algo.batch_size=256",)

    # algo= sets it.
    name: Literal["sac"] = "sac"
    discounting: float = doc("discount factor per step, 0 to 1", low=0.0, high=1.0)
    n_step: int = doc(
        "steps whose rewards a target sums before it takes the critics' estimate; fewer where an "
        "episode ends",
        default=1,
        low=1,
    )
    reward_scaling: float = doc(
        "factor on rewards before learning (logged returns are unscaled)", positive=True
    )
    batch_size: int = doc("transitions in one update of one GMI, drawn from its replay", low=1)
    updates_per_step: int = doc(
        "updates of the critics after every step of all environments of a GMI", low=1
    )
    policy_every: int = doc(
        "updates of the critics for every one of the policy; divides updates_per_step, or is a "
        "multiple of it that divides unroll_length x updates_per_step",
        low=1,
    )
    replay_steps: int = doc("steps of every environment that the replay holds", low=2)
    learning_starts: int = doc(
        "steps of every environment in the replay before the first update; a resumed run without "
        "its replay makes as many first",
        low=2,
    )
    replay_precision: Literal["float32", "float16"] = doc(
        "precision of observations and actions in the replay; float16 keeps the distance from the "
        "mean, by the statistics of the time",
        default="float32",
    )
    save_replay: bool = doc(
        "the checkpoint at the end of a run, or where it is stopped, holds the replay too, and a "
        "resumed run learns on with it; false, or after a fault: it fills the replay anew first",
        default=False,
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
    def kept_replay(self) -> KeptReplay:
        """See `PolicyConfig`."""
        keys = "replay_steps", "replay_precision"
        return KeptReplay(self.replay_steps, self.learning_starts, self.save_replay, keys)

    @property
    def kept_steps(self) -> int:
        """See `PolicyConfig`."""
        return self.replay_steps

    @property
    def kept_key(self) -> str:
        """See `PolicyConfig`."""
        return "algo.replay_steps"

    @property
    def kept_itemsize(self) -> int:
        """See `PolicyConfig`."""
        return 4 if self.replay_precision == "float32" else 2

    @property
    def rounds_per_turn(self) -> int:
        """Steps of all environments after which the policy learns, in them or once after them."""
        return max(1, self.policy_every // self.updates_per_step)

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """See `PolicyConfig`."""
        for key in ("serving_gmis_per_gpu", "serving_gpus", "training_gpus"):
            if (value := getattr(plan, key)) is not None:
                shown = value if isinstance(value, int) else list(value)
                raise ConfigError(
                    f"plan.{key}={shown}: with algo=sac every GMI acts and trains; "
                    f"write plan.{key}=null"
                )
        for key, is_wrong, allowed in (*self._sizes(num_envs), *self._policy()):
            if is_wrong:
                value = getattr(self, key)
                raise ConfigError(f"algo.{key}={value}: with algo=sac must be {allowed}")

    def _sizes(self, num_envs: int | None) -> Iterator[tuple[str, bool, str]]:
        """Keys, whether they are wrong, and what is allowed: of the replay and of updates."""
        length, updates, every = self.unroll_length, self.updates_per_step, self.policy_every
        in_round = updates % every == 0
        in_rounds = every % updates == 0 and length * updates % every == 0
        yield (
            "policy_every",
            not in_round and not in_rounds,
            f"a divisor of algo.updates_per_step={updates}, or a multiple of it that divides "
            f"algo.unroll_length x algo.updates_per_step = {length * updates}",
        )
        most = self.replay_steps
        yield "n_step", self.n_step >= most, f"less than algo.replay_steps={most}"
        yield "learning_starts", self.learning_starts > most, f"at most algo.replay_steps={most}"
        # None begins with the newest step, what follows that is not known yet.
        fewest = (num_envs or self.batch_size) * (self.learning_starts - 1)
        yield (
            "batch_size",
            self.batch_size > fewest,
            f"at most num_envs x (algo.learning_starts - 1) = {fewest}",
        )
        yield (
            "replay_precision",
            self.replay_precision != "float32" and not self.normalize_observations,
            "float32 where algo.normalize_observations=false",
        )

    def _policy(self) -> Iterator[tuple[str, bool, str]]:
        """The same of the policy and of what it learns from."""
        yield (
            "target_std",
            self.target_std > _WIDEST_STD,
            f"at most {_WIDEST_STD}: a distribution of actions in [-1, 1] has no more entropy",
        )
        only = "tanh_normal"
        yield "distribution_type", self.distribution_type != only, only
        yield "preserve_outputs", self.preserve_outputs, "false"
        yield "target_rate", self.target_rate > 1.0, "at most 1"
