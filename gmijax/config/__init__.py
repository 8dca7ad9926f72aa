"""The configuration of a run: frozen dataclasses and their checks.

No hydra and no jax here. Default values live in `configs/`, meanings live here: `--help` prints
the `doc` of every field. `gmijax.schema.from_dict` makes them from outside data.
"""

from __future__ import annotations

from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.plan import PlanConfig, ReduceConfig
from gmijax.config.play import PlayConfig, PlayRunConfig
from gmijax.config.ppo import ADAPTIVE_LEARNING_RATE_RANGE, PpoConfig
from gmijax.config.run import RunConfig
from gmijax.config.train import TrainConfig

__all__ = [
    "ADAPTIVE_LEARNING_RATE_RANGE",
    "EnvConfig",
    "PhysicsConfig",
    "PlanConfig",
    "PlayConfig",
    "PlayRunConfig",
    "PpoConfig",
    "ReduceConfig",
    "RunConfig",
    "TrainConfig",
]
