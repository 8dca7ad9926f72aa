"""The policy that a student learns from."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from gmijax.errors import ConfigError
from gmijax.learning.checkpoint import learner_sizes
from gmijax.learning.learner import ActingWeights, acting_weights, make_learner
from gmijax.learning.normalize import normalize
from gmijax.learning.policy import ActorCritic
from gmijax.learning.start import saved_state
from gmijax.runs.resume import find_checkpoint
from gmijax.runs.saved_config import trained_config
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array


class Teacher(NamedTuple):
    """A trained policy.

    Attributes:
      networks: its networks.
      weights: theirs, and the statistics of its observations.
    """

    networks: ActorCritic
    weights: ActingWeights

    def action(self, raw_obs: Array) -> Array:
        """What it does without noise [..., A] for raw observations [..., O], in [-1, 1]."""
        obs = normalize(self.weights.moments, raw_obs)
        # As every environment clips them: beyond that no two actions differ.
        return jnp.clip(self.networks.action_mean(self.weights.params, obs), -1.0, 1.0)


def load_teacher(named: str, spec: EnvSpec) -> Teacher:
    """The policy of a run folder or checkpoint, for an environment of the same sizes.

    Raises:
      ConfigError: there is no such checkpoint, or its observations or actions are others.
    """
    checkpoint = find_checkpoint(named, "algo.teacher")
    task, algo = trained_config(checkpoint)
    obs_size, _, action_size = learner_sizes(checkpoint)
    if (obs_size, action_size) != (spec.obs_size, spec.action_size):
        raise ConfigError(
            f"algo.teacher={named}: trained on {task.label} with {obs_size} observations and "
            f"{action_size} actions; {spec.name} has {spec.obs_size} and {spec.action_size}"
        )
    learner = make_learner(spec, algo)
    weights = acting_weights(learner, saved_state(checkpoint, learner, obs_size))
    return Teacher(learner.networks, weights)
