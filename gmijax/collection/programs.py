"""The policy that acts while experience is collected, and the compiled unroll of T steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.learning.checkpoint import digest
from gmijax.learning.learner import Learner, acting_moments, make_learner
from gmijax.learning.normalize import normalize
from gmijax.learning.start import saved_state
from gmijax.learning.unroll import Counts, Outcome, count, outcome_of
from gmijax.learning.unroll import unroll as run_steps
from gmijax.runs.saved_config import trained_config
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput, split_keys
from gmijax.types import Array, PRNGKey, PyTree

RANDOM: Final = "random"


class ActingPolicy(NamedTuple):
    """What chooses actions, with its weights on the device.

    Attributes:
      choose: `(weights, obs [N, O], keys [N]) -> (actions [N, A], log densities [N])`; consumes
        the keys. The log density of a policy that does not sample is 0.
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
    """The policy of a checkpoint's folder, which acts with the mean or samples.

    Raises:
      ConfigError: the checkpoint is broken, or of an environment with other sizes.
    """
    algo = trained_config(checkpoint)[1]
    learner = make_learner(spec, algo)
    state = saved_state(checkpoint, learner, spec.obs_size)
    weights = state.params, acting_moments(learner.config, state)
    sha = digest(weights).astype("uint16").tobytes().hex()
    return ActingPolicy(policy_of(learner, deterministic=deterministic), weights, sha)


def policy_of(
    learner: Learner, *, deterministic: bool
) -> Callable[[PyTree, Array, PRNGKey], tuple[Array, Array]]:
    """A function `(weights, obs, keys) -> (action, log density)`, see `ActingPolicy`.

    Without noise, if it is deterministic, and then with a density of 0.
    """

    def choose(weights: PyTree, obs: Array, keys: PRNGKey) -> tuple[Array, Array]:
        params, moments = weights
        output = networks.output(params, normalize(moments, obs))
        if deterministic:
            return distribution.mode(output), jnp.zeros(obs.shape[:1])
        raw = distribution.sample(output, params.log_std, keys)
        return distribution.action_of(raw), distribution.log_prob(output, params.log_std, raw)

    networks, distribution = learner.networks, learner.networks.distribution
    return choose


class CollectedStep(NamedTuple):
    """One step of N environments, as it is kept; over an unroll with a leading axis [T].

    Attributes:
      obs: [N, O], before the action.
      action: [N, A], before the task clips it.
      log_prob: [N], log density of the action under the policy.
      reward: [N].
      terminated, truncated: [N] bool, the task has ended; time ran out.
      next_obs: [N, O], before any reset; None where it is not kept.
    """

    obs: Array
    action: Array
    log_prob: Array
    reward: Array
    terminated: Array
    truncated: Array
    next_obs: Array | None


class RecordSpec(NamedTuple):
    """What of every step a program hands out."""

    steps: bool
    next_obs: bool

    def of(
        self, before: BatchState, log_prob: Array, action: Array, out: StepOutput
    ) -> CollectedStep | None:
        """The step, if it is kept."""
        if not self.steps:
            return None
        return CollectedStep(
            obs=before.env.obs,
            action=action,
            log_prob=log_prob,
            reward=out.reward,
            terminated=out.terminated,
            truncated=out.truncated,
            next_obs=out.next_obs if self.next_obs else None,
        )


def unroll(
    env: BatchedEnv,
    policy: ActingPolicy,
    length: int,
    keep: RecordSpec,
    model: PyTree,
    weights: PyTree,
    state: BatchState,
) -> tuple[BatchState, CollectedStep | None, Counts]:
    """T steps; returns the state, the steps [T, N] (None if not kept), and sums over all."""

    def choose(before: BatchState) -> tuple[BatchState, Array, Array]:
        drawn, keys = split_keys(before)
        action, log_prob = policy.choose(weights, before.env.obs, keys)
        return drawn, log_prob, action

    def kept(
        before: BatchState, log_prob: Array, action: Array, out: StepOutput
    ) -> tuple[CollectedStep | None, Array, Outcome]:
        return keep.of(before, log_prob, action, out), out.reward, outcome_of(out)

    state, (steps, rewards, outcomes) = run_steps(env, choose, length, kept, model, state)
    return state, steps, count(rewards, outcomes)
