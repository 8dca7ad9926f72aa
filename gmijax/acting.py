"""How a policy acts in a batch of environments: the same for every algorithm."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gmijax.normalize import Moments, normalize
from gmijax.policy import ActorCritic, ActorCriticParams
from gmijax.sim.wrappers import BatchState, split_keys
from gmijax.types import Array, PRNGKey


def policy_noise(keys: PRNGKey, action_size: int) -> Array:
    """Standard normal noise [N, A], each row from the key of its own environment.

    Rows depend on the environment alone, so the way environments are spread over GMIs does not
    change the samples.
    """
    return jax.vmap(lambda key: jax.random.normal(key, (action_size,)))(keys)


def act(
    networks: ActorCritic,
    params: ActorCriticParams,
    moments: Moments,
    env_state: BatchState,
    action_size: int,
) -> tuple[BatchState, Array, Array]:
    """Draws one action per environment: `(env_state, mean [N, A], action [N, A])`."""
    env_state, keys = split_keys(env_state)
    mean = networks.action_mean(params, normalize(moments, env_state.env.obs))
    noise = policy_noise(keys, action_size)
    return env_state, mean, mean + jnp.exp(params.log_std) * noise
