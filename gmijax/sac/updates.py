"""Updates of SAC: a batch of the replay, gradients, their mean over all GMIs, a step.

Those of the critics and of the policy are apart; `gmijax.sac.sac` decides when each is made.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from gmijax.collectives.interface import Collectives
from gmijax.learning.learner import acting_moments
from gmijax.learning.normalize import normalize
from gmijax.sac.critics import critics_of
from gmijax.sac.losses import (
    CriticFigures,
    critic_loss,
    policy_loss,
    sampled_action,
    target_probs,
    temperature_loss,
)
from gmijax.sac.replay import Replay, Transitions, sample, sample_obs
from gmijax.sac.state import SacLearner, SacState, optimizers
from gmijax.types import Array, PRNGKey, PyTree

_AVERAGE_RATE = 0.005
"""Share of the way that the average goes to `live` in an update of the policy."""

_ENTROPY_OF_UNIT_STD = 0.5 * math.log(2.0 * math.pi * math.e)


class UpdateFigures(NamedTuple):
    """Of the updates of several rounds, with leading axes for what they were made in.

    Attributes:
      figures: of the critics.
      policy_loss: None where the policy has not learnt.
      is_ready: whether updates counted.
    """

    figures: CriticFigures
    policy_loss: Array | None
    is_ready: Array


class SacLosses(NamedTuple):
    """Means over an iteration's updates, [] float32 each; 0 where there are none.

    Attributes:
      critic_loss: cross-entropy, summed over both critics.
      policy_loss: of its own updates.
      entropy: of the policy in next states, in nats.
      end_atoms: share of the targets at the ends of `value_range`; more than 0.01 shows that the
        range is too small for the rewards.
    """

    critic_loss: Array
    policy_loss: Array
    entropy: Array
    end_atoms: Array


def losses_of(updates: UpdateFigures) -> SacLosses:
    """Of all updates in an iteration: turns of the policy and their rounds, [T', T'']."""

    def mean(values: Array, is_ready: Array) -> Array:
        each = jnp.mean(values.reshape(*is_ready.shape, -1), axis=-1)
        return jnp.sum(jnp.where(is_ready, each, 0.0)) / jnp.maximum(jnp.sum(is_ready), 1)

    figures, policy_loss, is_ready = updates
    assert policy_loss is not None
    means = jax.tree.map(lambda values: mean(values, is_ready), figures)
    # Once in a turn, after its last round; or in every round.
    when = is_ready[:, -1] if policy_loss.ndim == 1 else is_ready
    return SacLosses(policy_loss=mean(policy_loss, when), **means._asdict())


def update_critics(
    learner: SacLearner, collectives: Collectives, replay: Replay, state: SacState, key: PRNGKey
) -> tuple[SacState, CriticFigures]:
    """One update of both critics, their targets and the temperature; consumes `key`."""
    batch_key, next_key = jax.random.split(key)
    batch = _batch(learner, state, replay, batch_key)
    own = _gradients(learner, state, batch, next_key)
    (critic_grads, temperature_grad), figures = collectives.mean(own)
    of_critics, of_policy, of_temperature = state.opt_states
    optimizer, _, temperature_optimizer = optimizers(learner.config)
    critics, of_critics = _step(optimizer, state, of_critics, critic_grads, state.critics)
    log_temperature, of_temperature = _step(
        temperature_optimizer, state, of_temperature, temperature_grad, state.log_temperature
    )
    rate = learner.config.target_rate
    state = state._replace(
        opt_states=(of_critics, of_policy, of_temperature),
        critics=critics,
        targets=_nearer(state.targets, critics, rate),
        log_temperature=log_temperature,
        updates=state.updates + 1,
    )
    return state, figures


def update_policy(
    learner: SacLearner, collectives: Collectives, replay: Replay, state: SacState, key: PRNGKey
) -> tuple[SacState, Array]:
    """One update of the policy, in states of a batch of its own; its loss []; consumes `key`."""
    batch_key, action_key = jax.random.split(key)
    config = learner.config
    raw = sample_obs(replay, batch_key, config.batch_size)
    own = jax.value_and_grad(policy_loss)(
        *(state.live, learner, critics_of(config), state.critics),
        *(normalize(acting_moments(config, state), raw), jnp.exp(state.log_temperature)),
        action_key,
    )
    loss, grads = collectives.mean(own)
    of_critics, of_policy, of_temperature = state.opt_states
    _, optimizer, _ = optimizers(config)
    live, of_policy = _step(optimizer, state, of_policy, grads, state.live)
    state = state._replace(
        params=_nearer(state.params, live, _AVERAGE_RATE),
        live=live,
        opt_states=(of_critics, of_policy, of_temperature),
    )
    return state, loss


def _nearer(slow: PyTree, new: PyTree, rate: float) -> PyTree:
    return jax.tree.map(lambda before, now: before + rate * (now - before), slow, new)


def _batch(learner: SacLearner, state: SacState, replay: Replay, key: PRNGKey) -> Transitions:
    """Transitions of this GMI's replay as the losses take them, by what is known now."""
    config = learner.config
    moments = acting_moments(config, state)
    drawn = sample(replay, key, config.batch_size, config.n_step, config.discounting)
    return drawn._replace(
        obs=normalize(moments, drawn.obs),
        reward=config.reward_scaling * drawn.reward,
        next_obs=normalize(moments, drawn.next_obs),
    )


def _gradients(
    learner: SacLearner, state: SacState, batch: Transitions, key: PRNGKey
) -> tuple[tuple[PyTree, Array], CriticFigures]:
    """Of critics and temperature; and figures."""
    critics, temperature = critics_of(learner.config), jnp.exp(state.log_temperature)
    next_action, next_log_prob = sampled_action(learner, state.live, batch.next_obs, key)
    wanted = target_probs(critics, state.targets, batch, next_action, next_log_prob, temperature)
    (loss, at_ends), critic_grads = jax.value_and_grad(critic_loss, has_aux=True)(
        state.critics, critics, batch, wanted
    )
    # FastSAC: the temperature learns with every update, from actions in next states.
    temperature_grad = jax.grad(temperature_loss)(
        state.log_temperature, next_log_prob, target_entropy(learner)
    )
    figures = CriticFigures(loss, -jnp.mean(next_log_prob), at_ends)
    return (critic_grads, temperature_grad), figures


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
