"""Keys of asynchronous training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.actor_critic import ActorCriticConfig
from gmijax.config.plan import PlanConfig
from gmijax.config.schema import doc
from gmijax.errors import ConfigError


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

    def check_job(self, num_envs: int | None, plan: PlanConfig) -> None:
        """See `PolicyConfig`."""
        del plan
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
