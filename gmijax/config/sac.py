"""Keys of SAC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.algo import PolicyConfig
from gmijax.config.schema import doc
from gmijax.errors import ConfigError

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
