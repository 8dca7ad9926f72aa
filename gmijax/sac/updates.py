"""An update of SAC: a batch of the replay, gradients, their mean over all GMIs, a step."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax

from gmijax.collectives.interface import Collectives
from gmijax.learning.learner import acting_moments
from gmijax.learning.normalize import normalize
from gmijax.learning.policy import ActorCriticParams
from gmijax.sac.critics import Critics, critics_of
from gmijax.sac.losses import (
    Batch,
    critic_loss,
    policy_loss,
    sampled_action,
    target_probs,
    temperature_loss,
)
from gmijax.sac.replay import Replay, sample
from gmijax.sac.state import SacLearner, SacLosses, SacState, optimizers
from gmijax.types import Array, PRNGKey, PyTree

_ENTROPY_OF_UNIT_STD = 0.5 * math.log(2.0 * math.pi * math.e)


def update(
    learner: SacLearner,
    collectives: Collectives,
    replay: Replay,
    state: SacState,
    key: PRNGKey,
) -> tuple[SacState, tuple[SacLosses, Array]]:
    """One update of the critics and the temperature, and of the policy if it is its turn.

    Returns also whether it was. Where several runs share a program the gradient of the policy is
    computed in every update, and used when it is its turn.
    """
    config, critics = learner.config, critics_of(learner.config)
    batch_key, next_key, policy_key = jax.random.split(key, 3)
    batch = _batch(learner, state, replay, batch_key)
    is_due = state.updates % config.policy_every == 0
    own = _gradients(learner, critics, state, batch, is_due, next_key, policy_key)
    (critic_grads, policy_grads, temperature_grad), losses = collectives.mean(own)
    of_critics, of_policy, of_temperature = optimizers(config)
    new_critics, critic_opt = _step(
        of_critics, state, state.opt_states[0], critic_grads, state.critics
    )
    new_params, policy_opt = _step(
        of_policy, state, state.opt_states[1], policy_grads, state.params
    )
    new_temperature, temperature_opt = _step(
        of_temperature, state, state.opt_states[2], temperature_grad, state.log_temperature
    )
    params, policy_opt = jax.tree.map(
        lambda new, old: jnp.where(is_due, new, old),
        (new_params, policy_opt),
        (state.params, state.opt_states[1]),
    )
    targets = jax.tree.map(
        lambda slow, new: slow + config.target_rate * (new - slow), state.targets, new_critics
    )
    state = state._replace(
        params=params,
        opt_states=(critic_opt, policy_opt, temperature_opt),
        critics=new_critics,
        targets=targets,
        log_temperature=new_temperature,
        updates=state.updates + 1,
    )
    return state, (losses, is_due)


def _batch(learner: SacLearner, state: SacState, replay: Replay, key: PRNGKey) -> Batch:
    """Transitions of this GMI's replay, normalised by what is known now."""
    config = learner.config
    moments = acting_moments(config, state)
    drawn = sample(replay, key, config.batch_size)
    return Batch(
        obs=normalize(moments, drawn.obs),
        action=drawn.action,
        reward=config.reward_scaling * drawn.reward,
        kind=drawn.kind,
        next_obs=normalize(moments, drawn.next_obs),
    )


def _gradients(
    learner: SacLearner,
    critics: Critics,
    state: SacState,
    batch: Batch,
    is_due: Array,
    next_key: PRNGKey,
    policy_key: PRNGKey,
) -> tuple[tuple[PyTree, ActorCriticParams, Array], SacLosses]:
    """Of critics, policy (zeros if it is not its turn) and temperature; and the losses."""
    temperature = jnp.exp(state.log_temperature)
    next_action, next_log_prob = sampled_action(learner, state.params, batch.next_obs, next_key)
    wanted = target_probs(
        critics, state.targets, learner.config, batch, next_action, next_log_prob, temperature
    )
    (loss, at_ends), critic_grads = jax.value_and_grad(critic_loss, has_aux=True)(
        state.critics, critics, batch, wanted
    )
    # FastSAC: the temperature learns with every update, from actions in next states.
    temperature_grad = jax.grad(temperature_loss)(
        state.log_temperature, next_log_prob, target_entropy(learner)
    )

    def policy_step() -> tuple[Array, ActorCriticParams]:
        return jax.value_and_grad(policy_loss)(
            *(state.params, learner, critics, state.critics),
            *(batch.obs, temperature, policy_key),
        )

    def no_step() -> tuple[Array, ActorCriticParams]:
        return jnp.zeros(()), jax.tree.map(jnp.zeros_like, state.params)

    of_policy, policy_grads = jax.lax.cond(is_due, policy_step, no_step)
    losses = SacLosses(loss, of_policy, -jnp.mean(next_log_prob), at_ends)
    return (critic_grads, policy_grads, temperature_grad), losses


def target_entropy(learner: SacLearner) -> float:
    """That of a Gaussian with `target_std` in every action, in nats."""
    each = _ENTROPY_OF_UNIT_STD + math.log(learner.config.target_std)
    return learner.networks.distribution.action_size * each


def _step(
    optimizer: optax.GradientTransformation,
    state: SacState,
    opt_state: PyTree,
    grads: PyTree,
    params: PyTree,
) -> tuple[Any, PyTree]:
    updates, opt_state = optimizer.update(grads, opt_state, params)
    rate = state.learning_rate
    return jax.tree.map(lambda p, u: p - rate * u, params, updates), opt_state
