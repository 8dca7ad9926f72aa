"""The policy of a learner's state as `policy.npz`, which needs neither Orbax nor jax to be used.

Its weights act in float32, whatever the run's `algo.precision`, as those of exported files do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gmijax.config import AlgoConfig, EnvConfig
from gmijax.config.schema import to_dict
from gmijax.learning.learner import LearnerState, acting_moments
from gmijax.learning.normalize import OBS_CLIP, std_of
from gmijax.player.policy import PlainPolicy, write_policy
from gmijax.runs.folder import POLICY, RunPaths
from gmijax.version import __version__


def save_policy(
    paths: RunPaths, env_steps: int, env: EnvConfig, algo: AlgoConfig, state: LearnerState
) -> None:
    """Writes it beside the learner's state, as `save_learner` does that.

    `state` is in the host's memory (`saved_arrays.on_host`).
    """
    path = paths.unfinished(env_steps) / POLICY
    write_policy(path, plain_policy(env, algo, state, env_steps=env_steps))


def plain_policy(
    env: EnvConfig, algo: AlgoConfig, state: LearnerState, **about: Any
) -> PlainPolicy:
    """The policy to act with when the learner has `state`; `about` is noted in it."""
    layers = state.params.policy["params"]
    num_norms = sum(name.startswith("LayerNorm_") for name in layers)
    names = [f"Dense_{number}" for number in range(len(layers) - num_norms)]
    norms = [layers[f"LayerNorm_{number}"] for number in range(num_norms)]
    kernels = [np.asarray(layers[name]["kernel"]) for name in names]
    moments = acting_moments(algo, state)
    seen = len(kernels[0])  # The statistics are also of what only the value function sees.
    knows = float(moments.count) > 0
    return PlainPolicy(
        kernels=kernels,
        biases=[np.asarray(layers[name]["bias"]) for name in names],
        obs_mean=np.asarray(moments.mean, np.float32)[:seen],
        obs_std=np.asarray(std_of(moments), np.float32)[:seen],
        # As `normalize` does, which leaves observations alone that nothing is known of.
        obs_clip=OBS_CLIP if knows else None,
        head=algo.distribution_type,
        action_size=len(state.params.log_std),
        about={"env": to_dict(env), **about, "gmijax_version": __version__},
        norms=[(np.asarray(norm["scale"]), np.asarray(norm["bias"])) for norm in norms],
    )
