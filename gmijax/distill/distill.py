"""An iteration of distillation: a rollout of the student, labelled by the teacher, then updates.

The student acts and the teacher labels the same states with its own actions (DAgger,
arXiv:1011.0686, with the newest rollout alone, as rsl_rl has it, arXiv:2509.10771). So the student
learns in states that it reaches itself, and may see less than the teacher does.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Collectives
from gmijax.config import DistillConfig
from gmijax.distill.teacher import load_teacher
from gmijax.learning.algorithm import Algorithm, IterationMetrics
from gmijax.learning.learner import (
    Learner,
    TrainState,
    acting_weights,
    finish_iteration,
    init_learner,
    make_learner,
    policy_figures,
)
from gmijax.learning.normalize import moments_of, normalize, without_outliers
from gmijax.learning.policy import ActorCriticParams
from gmijax.learning.unroll import RolloutSums, act, count, merge_sums, outcome_of, unroll
from gmijax.learning.updates import exchange_size, minibatch_order, run_updates
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree

DistillLearner: TypeAlias = Learner[DistillConfig]
"""`extra` is the `Teacher`."""


class DistillSamples(NamedTuple):
    """Inputs of the loss; leading axes are [T, N], [T * N] or [B].

    Attributes:
      obs: [..., O], normalised as the student saw it.
      target: [..., A], what the teacher does there without noise.
    """

    obs: Array
    target: Array


class DistillLosses(NamedTuple):
    """Means over a minibatch, [] float32 each.

    Attributes:
      imitation_loss: squared distance of the actions without noise, mean over their numbers.
    """

    imitation_loss: Array

    @property
    def steering_kl(self) -> Array:
        """None is followed: the learning rate is fixed."""
        return jnp.zeros(())


def iterate(
    env: BatchedEnv,
    learner: DistillLearner,
    collectives: Collectives,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> tuple[TrainState, BatchState, IterationMetrics]:
    """See `gmijax.learning.algorithm.Iterate`."""
    env_state, samples, stats = _rollout(env, learner, model, state, env_state)
    everyone = collectives.all_gather(stats)
    seen, counts = merge_sums(everyone)
    size = samples.target[..., 0].size
    order = minibatch_order(learner.config, state, collectives.rank(), size)
    flat = jax.tree.map(lambda x: x.reshape(size, *x.shape[2:]), samples)
    state, losses, _ = run_updates(
        learner, collectives, _gradients, state, flat, None, order, after=everyone
    )
    state = finish_iteration(learner, state, seen)
    means = jax.tree.map(jnp.mean, losses)
    return state, env_state, IterationMetrics(counts, means, policy_figures(state), {})


def _rollout(
    env: BatchedEnv,
    learner: DistillLearner,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> tuple[BatchState, DistillSamples, RolloutSums]:
    """T steps of the student, with the teacher's actions."""
    weights = acting_weights(learner, state)

    def keep(before: BatchState, drawn: Any, action: Array, out: StepOutput) -> Any:
        del drawn, action
        return before.env.obs, out.reward, outcome_of(out)

    env_state, (raw_obs, rewards, outcomes) = unroll(
        env,
        partial(act, learner.networks, weights),
        learner.config.unroll_length,
        keep,
        model,
        env_state,
    )
    seen = moments_of(without_outliers(weights.moments, raw_obs), 2)
    samples = DistillSamples(normalize(weights.moments, raw_obs), learner.extra.action(raw_obs))
    return env_state, samples, RolloutSums(seen, count(rewards, outcomes))


def _gradients(
    learner: DistillLearner,
    params: ActorCriticParams,
    samples: DistillSamples,
    context: None,
    indices: Array,
) -> tuple[ActorCriticParams, DistillLosses]:
    """Gradient and loss on the minibatch `indices` [B] of flat samples [T * N]."""
    del context
    obs, target = samples.obs[indices], samples.target[indices]

    def loss(params: ActorCriticParams) -> tuple[Array, DistillLosses]:
        error = jnp.mean((learner.networks.action_mean(params, obs) - target) ** 2)
        return error, DistillLosses(error)

    return jax.grad(loss, has_aux=True)(params)


def _make_learner(spec: EnvSpec, config: DistillConfig) -> DistillLearner:
    assert config.teacher is not None
    return make_learner(spec, config)._replace(extra=load_teacher(config.teacher, spec))


DISTILL = Algorithm(
    make_learner=_make_learner,
    init=init_learner,
    iterate=iterate,
    num_averaged=partial(exchange_size, losses=DistillLosses),
)
