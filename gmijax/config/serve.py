"""All keys of `python -m gmijax.serve`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.plan import PlanConfig
from gmijax.config.run import Timeouts
from gmijax.config.schema import KeyGroup, doc
from gmijax.config.search import AUTO, SearchConfig
from gmijax.errors import ConfigError

_MIN_PIPE_BYTES = 1 << 20
_PIPE_BYTES_PER_ENV = 8192
_EXCHANGE_TIMEOUT_S = 120.0


@dataclass(frozen=True, kw_only=True)
class ServeRunConfig(Timeouts):
    """Where the policy comes from, and the life of the job."""

    dir: str | None = doc(
        "trained run whose policy acts: its folder, one of its checkpoints, or `last`; without it "
        "and without policy=random: `last`"
    )
    name: str | None = doc(
        "name of the job's own folder below runs/; null: <env>-serve-<date>-<time>",
        may_be_empty=True,
    )

    @property
    def exchange_timeout_s(self) -> float:
        """The longest wait for another GMI in one exchange, seconds."""
        return min(_EXCHANGE_TIMEOUT_S, self.stall_timeout_s)


@dataclass(frozen=True, kw_only=True)
class OutputConfig(KeyGroup):
    """What is written of the experience."""

    prefix = "output."

    dir: str | None = doc("folder for the experience, made or continued; null: nothing is written")
    next_obs: bool = doc("write the observation before any reset too, to bootstrap from it")


@dataclass(frozen=True, kw_only=True)
class ServeConfig(KeyGroup):
    """All keys of `python -m gmijax.serve`."""

    env: EnvConfig
    physics: PhysicsConfig
    plan: PlanConfig
    run: ServeRunConfig
    output: OutputConfig
    search: SearchConfig
    policy: Literal["trained", "random"] = doc(
        "who acts: the policy of run.dir, or uniformly random actions"
    )
    deterministic: bool = doc("act with the policy's mean; false: sample actions")
    num_envs: int | Literal["auto"] = doc(
        "environments in each GMI that simulates; auto: the number that a search finds "
        "(docs/search.md)",
        low=1,
    )
    num_timesteps: int = doc("environment steps of the whole job, all GMIs together", low=1)
    unroll_length: int = doc("steps of one unroll, and of one shard of experience", low=1)
    latency_steps: int = doc(
        "steps timed one by one for the latency; 0: not measured", low=0, high=100_000
    )
    seed: int = doc("seed of every random number in the job", low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.plan.require_template(("tcg", "tdg"), "gmijax.serve")
        if self.policy == "trained" and self.run.dir is None:
            raise ConfigError(
                "policy=trained: needs run.dir=RUN (a trained run, or `last`); "
                "policy=random needs none"
            )
        if self.policy == "random" and self.run.dir is not None:
            raise ConfigError(
                f"policy=random: acts without the policy of run.dir={self.run.dir}; leave out one"
            )
        if self.policy == "random" and self.deterministic:
            raise ConfigError("deterministic=true: random actions have no mean to act with")

    @property
    def envs_per_gmi(self) -> int:
        """`num_envs` as a number; the controller decides an `auto` before it starts a GMI."""
        if self.num_envs == AUTO:
            raise ConfigError("num_envs=auto: not decided yet; expected an integer")
        return self.num_envs

    @property
    def pipe_bytes(self) -> int:
        """Capacity of a pipe between simulator and agent; a step's message may take half of it."""
        per_env = _PIPE_BYTES_PER_ENV * self.env.history
        return max(_MIN_PIPE_BYTES, self.envs_per_gmi * per_env)

    def unrolls_per_gmi(self, num_simulators: int) -> int:
        """Unrolls of each GMI that simulates, enough for `num_timesteps` in all."""
        return -(-self.num_timesteps // (num_simulators * self.envs_per_gmi * self.unroll_length))
