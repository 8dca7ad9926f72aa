"""Keys of PPO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.actor_critic import ActorCriticConfig
from gmijax.config.plan import PlanConfig
from gmijax.config.schema import doc
from gmijax.errors import ConfigError


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

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """See `PolicyConfig`."""
        if self.recompute_advantages and plan.template == "tdg_ex":
            raise ConfigError(
                "algo.recompute_advantages=true: for jobs in which every GMI trains; with "
                "plan.template=tdg_ex must be false"
            )
        super().check_job(num_envs, plan)
