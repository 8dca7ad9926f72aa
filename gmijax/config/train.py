"""All keys of `python -m gmijax.train`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

from gmijax.config.a3c import A3cConfig
from gmijax.config.channel import ChannelConfig
from gmijax.config.cluster import ClusterConfig
from gmijax.config.distill import DistillConfig
from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.evaluation import EvalConfig
from gmijax.config.plan import PlanConfig, ReduceConfig
from gmijax.config.ppo import PpoConfig
from gmijax.config.run import RunConfig, WandbConfig
from gmijax.config.sac import SacConfig
from gmijax.config.schema import KeyGroup, doc
from gmijax.config.search import SearchConfig
from gmijax.errors import ConfigError

AlgoConfig: TypeAlias = PpoConfig | A3cConfig | DistillConfig | SacConfig
"""The training algorithms; `algo.name` says which."""

ALGORITHMS: tuple[type[AlgoConfig], ...] = get_args(AlgoConfig)


@dataclass(frozen=True, kw_only=True)
class TrainConfig(KeyGroup):
    """All keys of `python -m gmijax.train`."""

    env: EnvConfig
    algo: AlgoConfig
    physics: PhysicsConfig
    plan: PlanConfig
    reduce: ReduceConfig
    channel: ChannelConfig
    run: RunConfig
    eval: EvalConfig
    search: SearchConfig
    wandb: WandbConfig
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    num_envs: int | Literal["auto"] = doc(
        "environments in each GMI; auto: the number that a search finds (docs/search.md)", low=1
    )
    num_timesteps: int = doc("environment steps of the whole job, all GMIs together", low=1)
    seed: int = doc("seed of every random number in the job", low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.plan.require_template(self.algo.templates, f"gmijax.train with algo={self.algo.name}")
        if self.eval.every is not None and self.is_decoupled:
            raise ConfigError(
                f"eval.every={self.eval.every}: with algo={self.algo.name} agents act all the "
                "time, and no GMI evaluates; allowed: null (gmijax.play evaluates a checkpoint)"
            )
        num_envs = None if self.num_envs == "auto" else self.num_envs
        self.algo.check_job(num_envs, self.plan)
        if self.cluster.engine is not None:
            self._check_on_nodes()

    @property
    def is_decoupled(self) -> bool:
        """Whether some GMIs act and others train, each at its own pace."""
        return self.algo.templates[0] == "decoupled"

    @property
    def envs_per_gmi(self) -> int:
        """`num_envs` as a number; the controller decides an `auto` before it starts a GMI."""
        if self.num_envs == "auto":
            raise ConfigError("num_envs=auto: not decided yet; expected an integer")
        return self.num_envs

    def _check_on_nodes(self) -> None:
        if self.plan.template not in (allowed := ("auto", "tcg_ex", "decoupled")):
            raise ConfigError(
                f"plan.template={self.plan.template}: not with "
                f"cluster.engine={self.cluster.engine} yet; allowed: {', '.join(allowed)}"
            )
        for key, value in (
            ("num_envs", self.num_envs),
            ("plan.gmis_per_gpu", self.plan.gmis_per_gpu),
        ):
            if value == "auto":
                raise ConfigError(
                    f"{key}=auto: a search is for one machine; with "
                    f"cluster.engine={self.cluster.engine} give a number (gmijax.search without "
                    "it finds one for a node)"
                )
        if isinstance(self.plan.gpus, tuple) and self.plan.backend != "cpu":
            raise ConfigError(
                f"plan.gpus={list(self.plan.gpus)}: Ray chooses the GPUs of nodes; expected a "
                "number, of each node"
            )
        if self.is_decoupled and self.cluster.nodes == "auto":
            raise ConfigError(
                f"cluster.nodes=auto: with algo={self.algo.name} give a number, because the "
                "GPUs of all nodes together are divided into those that act and those that train"
            )
