"""The losses of SAC (arXiv:1812.05905) with distributions of returns, as FastSAC has them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.config import SacConfig
from gmijax.learning.learner import Learner
from gmijax.learning.policy import ActorCriticParams
from gmijax.sac.critics import Critics, projected
from gmijax.sac.replay import Transitions
from gmijax.types import Array, PRNGKey, PyTree


class CriticFigures(NamedTuple):
    """Of an update of the critics, [] each; see `gmijax.sac.updates.SacLosses`."""

    critic_loss: Array
    entropy: Array
    end_atoms: Array


def sampled_action(
    learner: Learner[SacConfig], params: ActorCriticParams, obs: Array, key: PRNGKey
) -> tuple[Array, Array]:
    """Actions [B, A] of the policy and their log densities [B]; differentiable; consumes `key`."""
    distribution = learner.networks.distribution
    output = learner.networks.output(params, obs)
    raw = distribution.sample(output, params.log_std, jax.random.split(key, len(obs)))
    return distribution.action_of(raw), distribution.log_prob(output, params.log_std, raw)


def target_probs(
    critics: Critics,
    targets: PyTree,
    batch: Transitions,
    next_action: Array,
    next_log_prob: Array,
    temperature: Array,
) -> Array:
    """Targets [2, B, Z] of each critic: its own target critic's returns after the rewards.

    Of several steps the entropy counts in the last state alone, as in FastTD3 and FlashSAC.
    """
    after = critics.atoms - temperature * next_log_prob[:, None]
    values = batch.reward[:, None] + batch.discount[:, None] * after
    probs = jnp.exp(critics.log_probs(targets, batch.next_obs, next_action))
    # Apart: XLA for GPUs would make one kernel of softmax and projection, and compile it for ever.
    values, probs = jax.lax.optimization_barrier((values, probs))
    return jax.lax.stop_gradient(projected(critics.atoms, values, probs))


def critic_loss(
    params: PyTree, critics: Critics, batch: Transitions, wanted: Array
) -> tuple[Array, Array]:
    """Cross-entropy with `wanted` [2, B, Z], summed over critics, and the mass at both ends [].

    Each is a mean over transitions that are known.
    """
    counts = batch.is_known.astype(jnp.float32)
    weight = counts / jnp.maximum(jnp.sum(counts), 1.0)
    log_probs = critics.log_probs(params, batch.obs, batch.action)
    loss = -jnp.sum(jnp.sum(wanted * log_probs, axis=-1) * weight)
    at_ends = jnp.sum(jnp.mean(wanted[..., 0] + wanted[..., -1], axis=0) * weight)
    return loss, at_ends


def policy_loss(
    params: ActorCriticParams,
    learner: Learner[SacConfig],
    critics: Critics,
    critic_params: PyTree,
    obs: Array,
    temperature: Array,
    key: PRNGKey,
) -> Array:
    """Weighted log density minus the mean of both critics' values, mean over a batch."""
    action, log_prob = sampled_action(learner, params, obs, key)
    values = jnp.mean(critics.values(critic_params, obs, action), axis=0)
    return jnp.mean(temperature * log_prob - values)


def temperature_loss(log_temperature: Array, log_prob: Array, target_entropy: float) -> Array:
    """Falls with the temperature where the entropy, minus the mean `log_prob`, is too high."""
    return jnp.exp(log_temperature) * jax.lax.stop_gradient(-jnp.mean(log_prob) - target_entropy)
