"""Everything that `python -m gmijax.train` can be told."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.plan import PlanConfig, ReduceConfig
from gmijax.config.ppo import PpoConfig
from gmijax.config.run import RunConfig
from gmijax.errors import ConfigError
from gmijax.schema import doc, require_at_least, require_between


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that `python -m gmijax.train` can be told."""

    env: EnvConfig
    algo: PpoConfig
    physics: PhysicsConfig
    plan: PlanConfig
    reduce: ReduceConfig
    run: RunConfig
    num_envs: int = doc("N, environments per GMI")
    num_timesteps: int = doc("environment steps of the whole job, all GMIs together")
    seed: int = doc("seed of every random number in the job")

    def __post_init__(self) -> None:
        require_at_least("num_envs", self.num_envs, 1)
        require_at_least("num_timesteps", self.num_timesteps, 1)
        require_between("seed", self.seed, 0, 2**31 - 1)
        samples = self.num_envs * self.algo.unroll_length
        if samples % self.algo.num_minibatches:
            raise ConfigError(
                f"num_envs={self.num_envs}: num_envs x algo.unroll_length = {samples} samples "
                f"do not divide into algo.num_minibatches={self.algo.num_minibatches} minibatches"
            )
