"""The policy of a checkpoint as one function of raw observations; builds no environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gmijax.config import AlgoConfig
from gmijax.learning.checkpoint import learner_sizes
from gmijax.learning.learner import acting_weights, make_learner
from gmijax.learning.normalize import OBS_CLIP, Moments, normalize, std_of
from gmijax.learning.start import saved_state
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.saved_config import trained_config
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array
from gmijax.version import __version__, versions_of


class TrainedPolicy(NamedTuple):
    """A policy with its weights.

    Attributes:
      act: raw observations [N, O] to actions [N, A] in [-1, 1], the mean of the policy; pure, to
        be traced; in float32, whatever it was trained in.
      obs_size: O, of what the policy sees; not what only the value function saw.
      action_size: A.
      metadata: what it is, as plain data; what only the environment knows is not in it.
    """

    act: Callable[[Array], Array]
    obs_size: int
    action_size: int
    metadata: dict[str, Any]


def trained_policy(checkpoint: Path) -> TrainedPolicy:
    """The policy of a checkpoint folder.

    Raises:
      ConfigError: the checkpoint cannot be read, or does not lie in the folder of its run.
    """
    env, algo = trained_config(checkpoint)
    full_size, obs_size, action_size = learner_sizes(checkpoint)
    # Networks are made for the sizes of an environment, and nothing else of it.
    spec = EnvSpec(env.label, full_size, action_size, 0.0, 0, (), actor_obs_size=obs_size)
    # Weights are float32, and not every runtime has another format.
    learner = make_learner(spec, replace(algo, precision="float32"))
    weights = acting_weights(learner, saved_state(checkpoint, learner, full_size))
    count, mean, m2 = weights.moments
    moments = Moments(count, mean[:obs_size], m2[:obs_size])

    def act(obs: Array) -> Array:
        normalized = normalize(moments, obs)
        # As every environment clips them.
        return jnp.clip(learner.networks.action_mean(weights.params, normalized), -1.0, 1.0)

    metadata = {
        "task": env.label,
        "run": checkpoint.parents[1].name,
        "env_steps": CheckpointMeta.read(checkpoint).env_steps,
        "obs_size": obs_size,
        "action_size": action_size,
        "algo": algo.name,
        "policy_hidden_layer_sizes": list(algo.policy_hidden_layer_sizes),
        "value_hidden_layer_sizes": list(algo.hidden_layer_sizes[1]),
        **_normalizer(algo, moments),
        "gmijax_version": __version__,
        "jax_version": versions_of(["jax"])["jax"],
    }
    return TrainedPolicy(act, obs_size, action_size, metadata)


def _normalizer(algo: AlgoConfig, moments: Moments) -> dict[str, Any]:
    """Mean and standard deviation [O] of observations, and where they are clipped after it."""
    # As `normalize` does, which leaves observations alone that nothing is known of.
    knows = algo.normalize_observations and float(moments.count) > 0
    return {
        "obs_mean": np.asarray(moments.mean).tolist(),
        "obs_std": np.asarray(std_of(moments)).tolist(),
        "obs_clip": OBS_CLIP if knows else None,
    }
