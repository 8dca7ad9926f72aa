"""The learner's state and its pure update functions.

Two paths are built from them in `gmijax.ppo.programs`, and no third: one GMI runs the whole
iteration as one jit; several GMIs split at the gradient, with a reducer between the halves.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from gmijax.config import ADAPTIVE_LEARNING_RATE_RANGE, PpoConfig
from gmijax.normalize import Moments, merge, no_samples, std_of
from gmijax.policy import ActorCritic, ActorCriticParams, make_actor_critic
from gmijax.ppo.losses import LossMetrics, Samples, UpdateContext, ppo_loss
from gmijax.ppo.rollout import RolloutStats
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey, PyTree

_LEARNING_RATE_STEP = 1.5
_UNMOVED_KL = 1e-6


class LearnerState(NamedTuple):
    """All that learning must remember; equal, bit by bit, on every GMI.

    Attributes:
      params: weights of policy and value function.
      opt_state: Adam's moments.
      obs_moments: statistics of all observations before this iteration.
      learning_rate: [] float32.
      iteration: [] int32, finished iterations.
      key: base of the shuffling keys; never consumed, only folded with iteration and rank.
    """

    params: ActorCriticParams
    opt_state: PyTree
    obs_moments: Moments
    learning_rate: Array
    iteration: Array
    key: PRNGKey


class Learner(NamedTuple):
    """Networks, optimiser and hyper-parameters: what the update functions need, no arrays."""

    networks: ActorCritic
    optimizer: optax.GradientTransformation
    config: PpoConfig


def make_learner(spec: EnvSpec, config: PpoConfig) -> Learner:
    """The learner for an environment's sizes."""
    return Learner(
        networks=make_actor_critic(
            spec.action_size,
            config.policy_hidden_layer_sizes,
            config.value_hidden_layer_sizes,
            config.init_noise_std,
        ),
        # The learning rate is in the state, because the adaptive schedule changes it.
        optimizer=optax.chain(
            optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam()
        ),
        config=config,
    )


def init_learner(learner: Learner, obs_size: int, key: PRNGKey) -> LearnerState:
    """The first state; consumes `key`."""
    params_key, shuffle_key = jax.random.split(key)
    params = learner.networks.init(params_key, obs_size)
    return LearnerState(
        params=params,
        opt_state=learner.optimizer.init(params),
        obs_moments=no_samples((obs_size,)),
        learning_rate=jnp.asarray(learner.config.learning_rate, jnp.float32),
        iteration=jnp.zeros((), jnp.int32),
        key=shuffle_key,
    )


def acting_moments(learner: Learner, state: LearnerState) -> Moments:
    """The statistics that observations are normalised with (none if switched off)."""
    if learner.config.normalize_observations:
        return state.obs_moments
    return no_samples(state.obs_moments.mean.shape)


def minibatch_order(learner: Learner, state: LearnerState, rank: Array, samples: int) -> Array:
    """Sample indices [epochs * minibatches, B]: every sample once per epoch."""
    config = learner.config
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), rank)
    keys = jax.random.split(key, config.num_updates_per_batch)
    order = jax.vmap(lambda k: jax.random.permutation(k, samples))(keys)
    return order.reshape(config.num_updates_per_batch * config.num_minibatches, -1)


def update_context(learner: Learner, state: LearnerState, stats: RolloutStats) -> UpdateContext:
    """What all updates of an iteration share; `stats` are those of all GMIs together."""
    mean, std = stats.advantage.mean, std_of(stats.advantage)
    if not learner.config.normalize_advantage:
        mean, std = jnp.zeros(()), jnp.ones(())
    # A copy, because the updates donate the parameters that it would alias.
    return UpdateContext(mean, std, jnp.copy(state.params.log_std))


def gradients(
    learner: Learner,
    params: ActorCriticParams,
    samples: Samples,
    indices: Array,
    context: UpdateContext,
) -> tuple[ActorCriticParams, LossMetrics]:
    """Gradient and loss parts on the minibatch `indices` [B] of flat samples [T * N]."""
    minibatch = jax.tree.map(lambda x: x[indices], samples)
    return jax.grad(ppo_loss, has_aux=True)(
        params, minibatch, context, learner.networks, learner.config
    )


def apply_gradients(
    learner: Learner, state: LearnerState, grads: ActorCriticParams, losses: LossMetrics
) -> LearnerState:
    """One Adam step with the mean gradient of all GMIs."""
    rate = state.learning_rate
    if learner.config.learning_rate_schedule == "adaptive_kl":
        rate = adapted_learning_rate(rate, losses.kl, learner.config.desired_kl)
    updates, opt_state = learner.optimizer.update(grads, state.opt_state, state.params)
    params = jax.tree.map(lambda p, u: p - rate * u, state.params, updates)
    return state._replace(params=params, opt_state=opt_state, learning_rate=rate)


def finish_iteration(state: LearnerState, stats: RolloutStats) -> LearnerState:
    """Counts the iteration and takes its observations into the statistics.

    The statistics change only between iterations: the policy that is updated then sees the
    observations exactly as the policy that acted did, and the first probability ratio is 1.
    """
    return state._replace(
        obs_moments=merge(state.obs_moments, stats.obs), iteration=state.iteration + 1
    )


def adapted_learning_rate(rate: Array, kl: Array, desired_kl: float) -> Array:
    """Steers the rate to keep the KL divergence per update near `desired_kl`.

    Divided by 1.5 above twice the target, multiplied by 1.5 below half of it (the rule of
    Isaac Gym's trainers), within [1e-5, 1e-2]. No change below 1e-6: that is the first update
    on a rollout, where the policy has not moved yet and the rest is rounding.
    """
    low, high = ADAPTIVE_LEARNING_RATE_RANGE
    slower = jnp.maximum(rate / _LEARNING_RATE_STEP, low)
    faster = jnp.minimum(rate * _LEARNING_RATE_STEP, high)
    too_slow = (kl < 0.5 * desired_kl) & (kl > _UNMOVED_KL)
    return jnp.where(kl > 2.0 * desired_kl, slower, jnp.where(too_slow, faster, rate))
