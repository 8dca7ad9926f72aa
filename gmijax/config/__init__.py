"""The configuration of a run: frozen dataclasses and their checks.

No hydra and no jax here. Default values live in `configs/`, meanings live here: `--help` prints
the `doc` of every field. `gmijax.config.schema.from_dict` makes them from outside data.
"""

from __future__ import annotations

from gmijax.config.a3c import A3cConfig as A3cConfig
from gmijax.config.actor_critic import ADAPTIVE_LEARNING_RATE_RANGE as ADAPTIVE_LEARNING_RATE_RANGE
from gmijax.config.actor_critic import ActorCriticConfig as ActorCriticConfig
from gmijax.config.algo import RolloutConfig as RolloutConfig
from gmijax.config.channel import ChannelConfig as ChannelConfig
from gmijax.config.cluster import ClusterConfig as ClusterConfig
from gmijax.config.distill import DistillConfig as DistillConfig
from gmijax.config.env import EnvConfig as EnvConfig
from gmijax.config.env import PhysicsConfig as PhysicsConfig
from gmijax.config.evaluation import EvalConfig as EvalConfig
from gmijax.config.plan import BackendName as BackendName
from gmijax.config.plan import PlanConfig as PlanConfig
from gmijax.config.plan import ReduceConfig as ReduceConfig
from gmijax.config.plan import StrategyName as StrategyName
from gmijax.config.plan import TemplateName as TemplateName
from gmijax.config.play import ExportConfig as ExportConfig
from gmijax.config.play import PlayConfig as PlayConfig
from gmijax.config.play import PlayRunConfig as PlayRunConfig
from gmijax.config.ppo import PpoConfig as PpoConfig
from gmijax.config.run import RunConfig as RunConfig
from gmijax.config.run import Timeouts as Timeouts
from gmijax.config.run import WandbConfig as WandbConfig
from gmijax.config.sac import SacConfig as SacConfig
from gmijax.config.search import AUTO as AUTO
from gmijax.config.search import SearchConfig as SearchConfig
from gmijax.config.serve import OutputConfig as OutputConfig
from gmijax.config.serve import ServeConfig as ServeConfig
from gmijax.config.serve import ServeRunConfig as ServeRunConfig
from gmijax.config.train import ALGORITHMS as ALGORITHMS
from gmijax.config.train import AlgoConfig as AlgoConfig
from gmijax.config.train import TrainConfig as TrainConfig
from gmijax.config.view import PageConfig as PageConfig
from gmijax.config.view import ViewConfig as ViewConfig
