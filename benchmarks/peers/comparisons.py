"""The runs that are compared, as data: the settings of both sides are made from one tuple."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from gmijax.cli.compose import compose
from gmijax.config import ADAPTIVE_LEARNING_RATE_RANGE, PpoConfig, TrainConfig
from gmijax.errors import ConfigError

OURS, BRAX, MJLAB, FAST_TD3 = "gmijax", "Brax", "mjlab", "FastTD3"
MJLAB_TASK = "Mjlab-Velocity-Flat-Unitree-Go1"

REPORTS = 10
"""How often a trainer of Brax reports its progress. Between two reports it runs by itself."""


class Comparison(NamedTuple):
    """One training, by `gmijax.train` and by another library.

    With Brax's PPO the environment is ours, which Brax gets through `make_env(..., api="brax")`,
    or Brax's, or Playground's with the wrappers of its own script. mjlab trains a task of its own,
    and FastTD3 one of Playground's.

    Attributes:
      overrides: of `gmijax.train`. The settings of the other are made from the same.
      unrolls: Brax cuts the T steps of an iteration into so many unrolls. What an iteration
        collects, a minibatch has and an epoch goes over is the same; advantages look less far.
      peer: the other, `Brax`, `mjlab` or `FastTD3`.
    """

    overrides: tuple[str, ...]
    unrolls: int = 1
    peer: str = BRAX

    @property
    def suite(self) -> str:
        """Whose environment: `gmijax`, `brax` or `playground`."""
        theirs = (suite for suite in ("brax", "playground") if f"env={suite}" in self.overrides)
        return next(theirs, "gmijax")


_LIKE_BRAX = (
    "algo.learning_rate_schedule=fixed",
    "algo.learning_rate=3e-4",
    "algo.discounting=0.97",
    "algo.clipping_epsilon=0.3",
    "algo.clip_value_loss=false",
    "algo.value_cost=0.5",
    "algo.bound_cost=0",
    "algo.distribution_type=tanh_normal",
    "algo.state_dependent_std=true",
    "algo.num_minibatches=32",
)
"""Defaults of Brax's PPO, where ours are others."""

_BRAX_NETWORKS = (
    "algo.policy_hidden_layer_sizes=[32,32,32,32]",
    "algo.value_hidden_layer_sizes=[256,256,256,256,256]",
    "algo.max_grad_norm=1e9",  # Brax has no limit here.
)

# Steps are for 10 to 20 seconds of training on an H200.
COMPARISONS: Mapping[str, Comparison] = MappingProxyType(
    {
        # With the settings of `configs/tuned/`.
        "ant, MJX-Warp": Comparison(("env=ant", "physics.impl=warp", "num_timesteps=20000000")),
        "humanoid, MJX-Warp": Comparison(
            ("env=humanoid", "physics.impl=warp", "num_timesteps=10000000")
        ),
        # Settings of the notebook that comes with Brax (notebooks/training.ipynb).
        "Brax's ant": Comparison(
            (
                *("env=brax", "env.name=ant", *_LIKE_BRAX, *_BRAX_NETWORKS),
                *("num_envs=4096", "algo.unroll_length=80", "algo.num_updates_per_batch=4"),
                *("algo.entropy_cost=1e-2", "algo.reward_scaling=10", "num_timesteps=12000000"),
            ),
            unrolls=16,
        ),
        "Brax's humanoid": Comparison(
            (
                *("env=brax", "env.name=humanoid", *_LIKE_BRAX, *_BRAX_NETWORKS),
                *("num_envs=2048", "algo.unroll_length=160", "algo.num_updates_per_batch=8"),
                *("algo.entropy_cost=1e-3", "algo.reward_scaling=0.1", "num_timesteps=3500000"),
            ),
            unrolls=16,
        ),
        # Playground's own settings, but for the length.
        "Playground's CartpoleBalance": Comparison(
            (
                *("env=playground", "env.name=CartpoleBalance", "physics.impl=warp"),
                *("tuned=dm_control_ppo", "num_timesteps=20000000"),
            ),
            unrolls=16,
        ),
        "Playground's Go1JoystickFlatTerrain": Comparison(
            (
                *("env=playground", "env.name=Go1JoystickFlatTerrain", "physics.impl=warp"),
                *("tuned=locomotion_ppo", "num_timesteps=5000000"),
            )
        ),
        "Playground's G1JoystickFlatTerrain": Comparison(
            (
                *("env=playground", "env.name=G1JoystickFlatTerrain", "physics.impl=warp"),
                *("tuned=g1_ppo", "num_timesteps=5000000"),
            )
        ),
        # The nearest that there is: walking to a commanded velocity on flat ground.
        "anymal, and mjlab's Go1": Comparison(
            ("env=anymal", "physics.impl=warp", "num_envs=4096", "num_timesteps=10000000"),
            peer=MJLAB,
        ),
        # SAC with the settings of `configs/tuned/`, and TD3, on the same task: without pushes.
        "Go1, off-policy": Comparison(
            (
                *("env=go1", "algo=sac", "physics.impl=warp", "env.settings.push=0"),
                "num_timesteps=6000000",
            ),
            peer=FAST_TD3,
        ),
    }
)


def case_name(comparison: str, trainer: str) -> str:
    """The key of one side's runs in the file of results."""
    return f"{comparison}, {trainer}"


class BraxTraining(NamedTuple):
    """Settings for `benchmarks.peers.brax_ppo`.

    Attributes:
      suite: of the comparison.
      env: name of the environment.
      impl: MJX implementation of ours and Playground's.
      arguments: of `brax.training.agents.ppo.train.train`.
      networks: arguments of `make_ppo_networks`.
    """

    suite: str
    env: str
    impl: str
    arguments: dict[str, Any]
    networks: dict[str, Any]


def brax_training(
    comparison: Comparison, more: tuple[str, ...] = (), *, reports: int = REPORTS, seed: int = 0
) -> BraxTraining:
    """The other side of a comparison.

    Args:
      comparison: what is compared.
      more: overrides behind its own.
      reports: ends after so many of the `REPORTS` parts of the training. A part is one compiled
        program, and the same one however many there are.
      seed: of Brax's random numbers.

    Raises:
      ConfigError: a setting that Brax's PPO has no argument for, or that it cannot divide.
    """
    config: TrainConfig = compose(*comparison.overrides, *more)
    algo, num_envs = config.algo, config.envs_per_gmi
    if not isinstance(algo, PpoConfig):
        raise ConfigError(f"algo={algo.name}: Brax trains by ppo here")
    unrolls, rest = divmod(num_envs * comparison.unrolls, algo.num_minibatches)
    if rest or algo.unroll_length % comparison.unrolls:
        raise ConfigError(
            f"num_envs={num_envs}, algo.unroll_length={algo.unroll_length}: Brax needs "
            f"{comparison.unrolls} equal unrolls, and num_envs x {comparison.unrolls} of them in "
            f"algo.num_minibatches={algo.num_minibatches} equal minibatches"
        )
    iteration = num_envs * algo.unroll_length
    iterations = max(1, round(config.num_timesteps / iteration / REPORTS))
    arguments = {
        "num_timesteps": reports * iterations * iteration,
        "num_evals": reports + 1,
        "seed": seed,
        "num_envs": num_envs,
        "episode_length": config.env.episode_length,
        "action_repeat": config.env.action_repeat,
        "unroll_length": algo.unroll_length // comparison.unrolls,
        "batch_size": unrolls,
        "num_minibatches": algo.num_minibatches,
        "num_updates_per_batch": algo.num_updates_per_batch,
        **_losses(algo),
        **_learning_rate(algo),
        "normalize_observations": algo.normalize_observations,
        "run_evals": False,
        "max_devices_per_host": 1,
    }
    networks = {
        "policy_hidden_layer_sizes": algo.policy_hidden_layer_sizes,
        "value_hidden_layer_sizes": algo.value_hidden_layer_sizes,
        "distribution_type": algo.distribution_type,
        "state_dependent_std": algo.state_dependent_std,
        "noise_std_type": "log",
        "init_noise_std": algo.init_noise_std,
    }
    name = config.env.name or ""
    return BraxTraining(comparison.suite, name, config.physics.impl, arguments, networks)


def _losses(algo: PpoConfig) -> dict[str, Any]:
    return {
        "discounting": algo.discounting,
        "gae_lambda": algo.gae_lambda,
        "clipping_epsilon": algo.clipping_epsilon,
        "clipping_epsilon_value": algo.clipping_epsilon if algo.clip_value_loss else None,
        "vf_loss_coefficient": algo.value_cost,
        "entropy_cost": algo.entropy_cost,
        "reward_scaling": algo.reward_scaling,
        "normalize_advantage": algo.normalize_advantage,
        "max_grad_norm": algo.max_grad_norm,
    }


def _learning_rate(algo: PpoConfig) -> dict[str, Any]:
    low, high = ADAPTIVE_LEARNING_RATE_RANGE
    return {
        "learning_rate": algo.learning_rate,
        "learning_rate_schedule": {"fixed": "NONE", "adaptive_kl": "ADAPTIVE_KL"}[
            algo.learning_rate_schedule
        ],
        "learning_rate_schedule_min_lr": low,
        "learning_rate_schedule_max_lr": high,
        "desired_kl": algo.desired_kl,
    }


def mjlab_training(
    comparison: Comparison, more: tuple[str, ...] = (), *, seed: int = 0
) -> dict[str, Any]:
    """Settings for `benchmarks.peers.mjlab_ppo`: as many environments and steps, its own rest."""
    config: TrainConfig = compose(*comparison.overrides, *more)
    iteration = config.envs_per_gmi * config.algo.unroll_length
    return {
        "task": MJLAB_TASK,
        "num_envs": config.envs_per_gmi,
        "iterations": max(2, round(config.num_timesteps / iteration)),
        "seed": seed,
    }


def missing_package(comparison: Comparison, more: tuple[str, ...] = ()) -> str | None:
    """The package that a comparison needs and that is not installed here."""
    impls = [one for one in (*comparison.overrides, *more) if one.startswith("physics.impl=")]
    needed = ["brax"] if comparison.peer == BRAX else []
    if comparison.suite == "playground" or comparison.peer == FAST_TD3:
        needed += ["mujoco_playground"]
    needed += ["warp"] if impls[-1:] == ["physics.impl=warp"] else []
    return next((name for name in needed if importlib.util.find_spec(name) is None), None)
