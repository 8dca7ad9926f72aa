"""The settings of FastTD3, made from those of our SAC."""

from __future__ import annotations

from typing import Any

from benchmarks.peers.comparisons import Comparison
from gmijax.cli.compose import compose
from gmijax.config import SacConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.sim.robots import playground_name


def fast_td3_training(
    comparison: Comparison, more: tuple[str, ...] = (), *, seed: int = 0
) -> dict[str, Any]:
    """Settings for `benchmarks.peers.fast_td3` without `checkout`; the rest is FastTD3's own.

    As much work: environments, steps, updates, transitions in one, layers as wide, atoms, and a
    replay as large. It is TD3, without layer norm, and with its own rates, noise and range of
    values for this task; the policy learns as often, from the batch of the critics.

    Raises:
      ConfigError: a setting that FastTD3 has no flag for.
    """
    config: TrainConfig = compose(*comparison.overrides, *more)
    algo, num_envs = config.algo, config.envs_per_gmi
    if not isinstance(algo, SacConfig):
        raise ConfigError(f"algo={algo.name}: FastTD3 is compared with sac")
    if algo.batch_size % num_envs:
        raise ConfigError(
            f"algo.batch_size={algo.batch_size}: FastTD3 draws as many from each of "
            f"num_envs={num_envs}"
        )
    flags = {
        "env-name": playground_name(config.env.name or ""),
        "seed": seed,
        "num-envs": num_envs,
        "total-timesteps": max(20, round(config.num_timesteps / num_envs)),
        "batch-size": algo.batch_size,
        "num-updates": algo.updates_per_step,
        "policy-frequency": algo.policy_every,
        "buffer-size": algo.replay_steps,
        "learning-starts": algo.learning_starts,
        "num-steps": algo.n_step,
        "gamma": algo.discounting,
        "num-atoms": algo.num_atoms,
        "critic-hidden-dim": _halving("critic", algo.critic_hidden_layer_sizes),
        "actor-hidden-dim": _halving("policy", algo.policy_hidden_layer_sizes),
        "amp": algo.precision == "bfloat16",
        "use-wandb": False,
        **dict.fromkeys(("eval-interval", "render-interval", "save-interval"), 0),
    }
    return {"impl": config.physics.impl, "flags": flags}


def _halving(network: str, sizes: tuple[int, ...]) -> int:
    """The first of three widths, of which each is half of the one before it."""
    if sizes != (sizes[0], sizes[0] // 2, sizes[0] // 4):
        raise ConfigError(
            f"algo.{network}_hidden_layer_sizes={list(sizes)}: FastTD3 has three layers, each "
            "half as wide as the one before it"
        )
    return sizes[0]
