"""Who acts while experience is collected: a trained policy, or random actions."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.checkpoint import digest, restore_learner
from gmijax.learner import Learner, acting_moments, init_learner, make_learner
from gmijax.learning.unroll import policy_noise
from gmijax.normalize import normalize
from gmijax.policy import log_prob
from gmijax.resume import trained_config
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey, PyTree

RANDOM: Final = "random"


class ActingPolicy(NamedTuple):
    """What chooses actions.

    Attributes:
      choose: `(weights, obs [N, O], keys [N]) -> (actions [N, A], log densities [N])`; consumes
        the keys. The log density of a policy that does not sample is 0.
      weights: what `choose` needs, on the device.
      digest: hexadecimal SHA-256 of the weights, or `random`.
    """

    choose: Callable[[PyTree, Array, PRNGKey], tuple[Array, Array]]
    weights: PyTree
    digest: str


def random_policy(spec: EnvSpec) -> ActingPolicy:
    """Actions uniform in [-1, 1], independent of what is observed."""
    size = spec.action_size

    def choose(weights: PyTree, obs: Array, keys: PRNGKey) -> tuple[Array, Array]:
        del weights
        draw = jax.vmap(lambda key: jax.random.uniform(key, (size,), minval=-1.0))
        return draw(keys), jnp.full(obs.shape[:1], -size * math.log(2.0))

    return ActingPolicy(choose, (), RANDOM)


def trained_policy(checkpoint: Path, spec: EnvSpec, *, deterministic: bool) -> ActingPolicy:
    """The policy of a checkpoint.

    Args:
      checkpoint: its folder, in the folder of its run.
      spec: sizes of the environment.
      deterministic: act with the mean; else sample.

    Raises:
      ConfigError: the checkpoint is broken, or of an environment with other sizes.
    """
    learner = make_learner(spec, trained_config(checkpoint)[1])
    start = jax.jit(lambda key: init_learner(learner, spec.obs_size, key))(jax.random.key(0))
    state = restore_learner(checkpoint, start)
    weights = state.params, acting_moments(learner, state)
    sha = digest(weights).astype("uint16").tobytes().hex()
    return ActingPolicy(_gaussian(learner, spec.action_size, deterministic), weights, sha)


def _gaussian(
    learner: Learner, size: int, deterministic: bool
) -> Callable[[PyTree, Array, PRNGKey], tuple[Array, Array]]:
    def choose(weights: PyTree, obs: Array, keys: PRNGKey) -> tuple[Array, Array]:
        params, moments = weights
        mean = learner.networks.action_mean(params, normalize(moments, obs))
        if deterministic:
            return mean, jnp.zeros(obs.shape[:1])
        action = mean + jnp.exp(params.log_std) * policy_noise(keys, size)
        return action, log_prob(mean, params.log_std, action)

    return choose
