"""An iteration of SAC: T times a step into the replay and updates on batches drawn from it.

Agents and learner take turns in one program. Where several GMIs train, each has its own
environments and its own replay, and they average the gradients of their batches.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from gmijax.collectives.interface import Collectives
from gmijax.config import SacConfig
from gmijax.learning.algorithm import Algorithm, IterationMetrics
from gmijax.learning.learner import (
    Learner,
    acting_moments,
    acting_weights,
    finish_iteration,
    make_learner,
    policy_figures,
)
from gmijax.learning.normalize import (
    Moments,
    moments_of,
    no_samples,
    normalize,
    without_outliers,
)
from gmijax.learning.policy import ActorCriticParams
from gmijax.learning.unroll import RolloutSums, act, count, merge_sums, outcome_of, unroll
from gmijax.sac.critics import Critics, critics_of
from gmijax.sac.losses import (
    Batch,
    critic_loss,
    policy_loss,
    sampled_action,
    target_probs,
    temperature_loss,
)
from gmijax.sac.replay import Replay, empty_replay, insert, kind_of, sample
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PRNGKey, PyTree

SacLearner: TypeAlias = Learner[SacConfig]

_BETAS, _WEIGHT_DECAY = (0.9, 0.95), 1e-3
"""Of Adam, with weight decay, as FastSAC has it."""

_ENTROPY_OF_UNIT_STD = 0.5 * math.log(2.0 * math.pi * math.e)


class SacState(NamedTuple):
    """All that learning must remember; equal, bit by bit, on every GMI.

    Attributes:
      params: weights of the policy; `value` is empty.
      opt_states: of critics, policy and temperature.
      obs_moments: statistics of all observations before this iteration.
      learning_rate: [] float32.
      iteration: [] int32, finished iterations.
      key: base of the keys of updates; never consumed, only folded with iteration and rank.
      critics: weights of both critics, [2, ...].
      targets: slow copies of them.
      log_temperature: [] of the weight of the entropy.
      updates: [] int32, of the critics.
      value_moments: None, there is no value function.
    """

    params: ActorCriticParams
    opt_states: tuple[PyTree, PyTree, PyTree]
    obs_moments: Moments
    learning_rate: Array
    iteration: Array
    key: PRNGKey
    critics: PyTree
    targets: PyTree
    log_temperature: Array
    updates: Array
    value_moments: None = None


class Memory(NamedTuple):
    """What a GMI keeps for itself: its environments, and what they have done."""

    envs: BatchState
    replay: Replay


class SacLosses(NamedTuple):
    """Means over an iteration's updates, [] float32 each.

    Attributes:
      critic_loss: cross-entropy, summed over both critics.
      policy_loss: of those updates in which the policy learns.
      entropy: of the policy in next states, in nats.
      end_atoms: share of the targets at the ends of `value_range`; more than 0.01 says that the
        range is too small for the rewards.
    """

    critic_loss: Array
    policy_loss: Array
    entropy: Array
    end_atoms: Array


def init(learner: SacLearner, obs_size: int, key: PRNGKey) -> SacState:
    """The first state; consumes `key`."""
    config, networks = learner.config, learner.networks
    params_key, critics_key, shuffle_key = jax.random.split(key, 3)
    params = networks.init(params_key, obs_size)
    critics = critics_of(config).init(critics_key, obs_size, networks.distribution.action_size)
    log_temperature = jnp.log(jnp.asarray(config.init_temperature, jnp.float32))
    of_critics, of_policy, of_temperature = _optimizers(config)
    return SacState(
        params=params,
        opt_states=(
            of_critics.init(critics),
            of_policy.init(params),
            of_temperature.init(log_temperature),
        ),
        obs_moments=no_samples((obs_size,)),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        iteration=jnp.zeros((), jnp.int32),
        key=shuffle_key,
        critics=critics,
        targets=jax.tree.map(jnp.copy, critics),
        log_temperature=log_temperature,
        updates=jnp.zeros((), jnp.int32),
    )


def begin(learner: SacLearner, env: BatchedEnv, envs: BatchState) -> Memory:
    """The environments with an empty replay."""
    num_envs = envs.env.reward.shape[0]
    return Memory(envs, empty_replay(env.spec, learner.config.replay_steps, num_envs))


def iterate(
    env: BatchedEnv,
    learner: SacLearner,
    collectives: Collectives,
    model: PyTree,
    state: SacState,
    memory: Memory,
) -> tuple[SacState, Memory, IterationMetrics]:
    """See `gmijax.learning.algorithm.Iterate`: T rounds of a step and its updates."""
    config = learner.config
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), collectives.rank())
    keys = jax.random.split(key, config.unroll_length)
    one_round = partial(_round, env, learner, collectives, model)
    (state, memory), (stats, losses, is_due) = jax.lax.scan(one_round, (state, memory), keys)
    everyone = collectives.all_gather(merge_sums(stats), after=losses)
    seen, counts = merge_sums(everyone)
    state = finish_iteration(learner, state, seen)
    figures = {
        **policy_figures(state),
        "policy/temperature": jnp.exp(state.log_temperature),
        "replay/steps": memory.replay.filled.astype(jnp.float32),
    }
    means = jax.tree.map(jnp.mean, losses)
    of_policy = jnp.sum(losses.policy_loss) / jnp.maximum(jnp.sum(is_due), 1.0)
    means = means._replace(policy_loss=of_policy)
    return state, memory, IterationMetrics(counts, means, figures, {})


def _round(
    env: BatchedEnv,
    learner: SacLearner,
    collectives: Collectives,
    model: PyTree,
    before: tuple[SacState, Memory],
    key: PRNGKey,
) -> tuple[tuple[SacState, Memory], tuple[RolloutSums, SacLosses, Array]]:
    """A step of all environments, and the updates after it."""
    config, (state, memory) = learner.config, before
    memory, stats = _act(env, learner, model, state, memory)
    update = partial(_update, learner, collectives, memory.replay)
    keys = jax.random.split(key, config.updates_per_step)
    after, (losses, is_due) = jax.lax.scan(update, state, keys)
    # The same on all GMIs, whose replays fill alike. Before, there is too little to learn from.
    is_ready = memory.replay.filled >= config.learning_starts
    state = jax.tree.map(lambda new, old: jnp.where(is_ready, new, old), after, state)
    losses = jax.tree.map(lambda x: jnp.where(is_ready, x, 0.0), losses)
    return (state, memory), (stats, losses, is_due & is_ready)


def _act(
    env: BatchedEnv, learner: SacLearner, model: PyTree, state: SacState, memory: Memory
) -> tuple[Memory, RolloutSums]:
    """A step of this GMI's environments, into its replay."""
    weights = acting_weights(learner, state)

    def keep(before: BatchState, drawn: Any, action: Array, out: StepOutput) -> Any:
        del drawn
        kind = kind_of(out.terminated, out.truncated, out.is_diverged)
        return before.env.obs, action, out.reward, kind, outcome_of(out)

    envs, (obs, action, reward, kind, outcomes) = unroll(
        env,
        partial(act, learner.networks, weights),
        1,
        keep,
        model,
        memory.envs,
    )
    # Each observation counts once, when it is made: batches show the same ones again and again.
    seen = moments_of(without_outliers(weights.moments, obs), 2)
    replay = insert(memory.replay, obs, action, reward, kind)
    return Memory(envs, replay), RolloutSums(seen, count(reward, outcomes))


def _update(
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
    optimizers = _optimizers(config)
    new_critics, critic_opt = _step(
        optimizers[0], state, state.opt_states[0], critic_grads, state.critics
    )
    new_params, policy_opt = _step(
        optimizers[1], state, state.opt_states[1], policy_grads, state.params
    )
    new_temperature, temperature_opt = _step(
        optimizers[2], state, state.opt_states[2], temperature_grad, state.log_temperature
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


def _optimizers(config: SacConfig) -> tuple[optax.GradientTransformation, ...]:
    """Of critics, policy and temperature; without the learning rate, which is in the state."""
    adam = optax.scale_by_adam(*_BETAS)
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    decayed = optax.flatten(optax.chain(clip, adam, optax.add_decayed_weights(_WEIGHT_DECAY)))
    return decayed, decayed, adam


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


def _num_averaged(spec: EnvSpec, config: SacConfig) -> int:
    learner = make_learner(spec, config)
    state = jax.eval_shape(lambda: init(learner, spec.obs_size, jax.random.key(0)))
    learned = state.critics, state.params, state.log_temperature
    return sum(leaf.size for leaf in jax.tree.leaves(learned)) + len(SacLosses._fields)


SAC = Algorithm(
    make_learner=make_learner,
    init=init,
    iterate=iterate,
    num_averaged=_num_averaged,
    begin=begin,
    envs=lambda memory: memory.envs,
    learned=lambda state: (state.params, state.critics, state.targets, state.log_temperature),
)
