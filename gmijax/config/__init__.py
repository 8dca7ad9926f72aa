"""The configuration of a run: frozen dataclasses and their checks.

No hydra and no jax here. Default values live in `configs/`, meanings live here: `--help` prints
the `doc` of every field. `gmijax.config.schema.from_dict` makes them from outside data.
"""

from __future__ import annotations

from gmijax.config.algo import (
    ADAPTIVE_LEARNING_RATE_RANGE,
    A3cConfig,
    ActorCriticConfig,
    PpoConfig,
)
from gmijax.config.channel import ChannelConfig
from gmijax.config.cluster import ClusterConfig
from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.evaluation import EvalConfig
from gmijax.config.plan import (
    BackendName,
    PlanConfig,
    Priority,
    ReduceConfig,
    StrategyName,
    TemplateName,
)
from gmijax.config.play import ExportConfig, PlayConfig, PlayRunConfig
from gmijax.config.run import RunConfig, Timeouts, WandbConfig
from gmijax.config.search import AUTO, SearchConfig
from gmijax.config.serve import OutputConfig, ServeConfig, ServeRunConfig
from gmijax.config.train import ALGORITHMS, AlgoConfig, TrainConfig

__all__ = [
    "ADAPTIVE_LEARNING_RATE_RANGE",
    "ALGORITHMS",
    "AUTO",
    "A3cConfig",
    "ActorCriticConfig",
    "AlgoConfig",
    "BackendName",
    "ChannelConfig",
    "ClusterConfig",
    "EnvConfig",
    "EvalConfig",
    "ExportConfig",
    "OutputConfig",
    "PhysicsConfig",
    "PlanConfig",
    "PlayConfig",
    "PlayRunConfig",
    "PpoConfig",
    "Priority",
    "ReduceConfig",
    "RunConfig",
    "SearchConfig",
    "ServeConfig",
    "ServeRunConfig",
    "StrategyName",
    "TemplateName",
    "Timeouts",
    "TrainConfig",
    "WandbConfig",
]
