"""What stands between a task and the training loop: batch, auto-reset, statistics.

`training_env` puts them together. Results of environment j depend on its own random key only, so
k processes with n environments each see the samples of one process with k x n, given the keys of
`env_keys`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from gmijax.errors import ConfigError
from gmijax.sim.divergence import diverged_by_source, end_diverged
from gmijax.sim.interface import OVERFLOWS, Env, EnvSpec, EnvState
from gmijax.types import Array, PRNGKey, PyTree

T = TypeVar("T")

_HEAD_START = 0x68656164
"""Folded into an environment's key for the length of its first episode."""


class EpisodeSums(NamedTuple):
    """Sums over the episodes that ended in one step; add those of several steps or GMIs.

    Attributes:
      count: [] int32, how many ended.
      return_sum: [] float32, of their undiscounted returns.
      length_sum: [] int32, of their lengths in steps.
      term_sums: of what every term added to their returns, [] float32 each.
      metric_sums: of every metric's value at their ends, [] float32 each.
    """

    count: Array
    return_sum: Array
    length_sum: Array
    term_sums: dict[str, Array]
    metric_sums: dict[str, Array]


class BatchState(NamedTuple):
    """State of N environments.

    Attributes:
      env: all environments; its `obs` [N, O] is the one after auto-reset, to act on next.
      return_sum: [N] float32, return of the running episode so far.
      term_sums: [N] float32 each, what every term has added to it.
      head_start: [N] int32, steps by which the running episode of an environment is shorter than
        its time limit: the first one; else 0.
    """

    env: EnvState
    return_sum: Array
    term_sums: dict[str, Array]
    head_start: Array


class StepOutput(NamedTuple):
    """Outcome of one step of N environments.

    Attributes:
      next_obs: [N, O] float32, what the action led to, before any auto-reset.
      reward: [N] float32.
      terminated: [N] bool, the task has ended.
      truncated: [N] bool, time ran out.
      is_diverged: [N] bool, the environment was ended because of a bad number (it counts as
        terminated).
      finished: the whole episodes that ended in this step; none that had a head start.
      diverged: [] int32, environments that were ended because of a bad number, by where it was:
        `gmijax.sim.divergence.sources`.
      overflowed: [] int32, environments for which a buffer was too small, by `OVERFLOWS`; empty if
        nothing can overflow.
    """

    next_obs: Array
    reward: Array
    terminated: Array
    truncated: Array
    is_diverged: Array
    finished: EpisodeSums
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


class BatchedEnv(NamedTuple):
    """N environments that start over by themselves.

    Attributes:
      spec: sizes and names of one environment.
      model: the physics model; pass it, or a randomised copy, to the functions.
      init: `(model, keys [N]) -> BatchState`; `env_keys` makes the keys, which it consumes.
      step: `(model, state, actions [N, A]) -> (BatchState, StepOutput)`, `advance` and `restart`.
      advance: as `step`, but environments that ended stay at their end.
      restart: `(model, state) -> BatchState`, with new episodes where one has ended.
      overflows: the names in `StepOutput.overflowed`.
    """

    spec: EnvSpec
    model: PyTree
    init: Callable[[PyTree, PRNGKey], BatchState]
    step: Callable[[PyTree, BatchState, Array], tuple[BatchState, StepOutput]]
    advance: Callable[[PyTree, BatchState, Array], tuple[BatchState, StepOutput]]
    restart: Callable[[PyTree, BatchState], BatchState]
    overflows: tuple[str, ...] = ()


def vectorise(env: Env) -> Env:
    """A batch of N such environments; they share the model, or most of its leaves."""
    again = env.next_episode
    return env._replace(
        reset=jax.vmap(env.reset, in_axes=(env.model_axes, 0)),
        step=jax.vmap(env.step, in_axes=(env.model_axes, 0, 0)),
        next_episode=None if again is None else jax.vmap(again, in_axes=(env.model_axes, 0)),
    )


def auto_reset(env: Env, model: PyTree, state: EnvState) -> EnvState:
    """Starts new random episodes where `state` [N] has ended; `env` is vectorised.

    An environment's key moves on only if the environment is reset, so when other environments end
    does not matter.
    """
    ended = state.terminated | state.truncated
    again = env.next_episode
    fresh = env.reset(model, state.key) if again is None else again(model, state)
    return select_envs(ended, fresh, state)


def select_env(chosen: Array, new: T, old: T) -> T:
    """`new` if the environment is `chosen` [] bool, else `old`.

    What has a method `where` selects for itself: `mjx.Data` in states of MuJoCo Playground. In
    MJX-Warp it holds contacts that all environments share.
    """

    def select(a: Any, b: Any) -> Any:
        return b.where(chosen, a) if _selects_itself(b) else jnp.where(chosen, a, b)

    return jax.tree.map(select, new, old, is_leaf=_selects_itself)


def _selects_itself(node: Any) -> bool:
    return callable(getattr(type(node), "where", None))


select_envs = jax.vmap(select_env)
"""`select_env` of N environments."""


def cut_first_episodes(spec: EnvSpec, before: BatchState, state: EnvState) -> EnvState:
    """`state` [N], truncated where an episode that had a head start is out of time."""
    time_left = spec.episode_length - before.head_start - state.steps
    out_of_time = (before.head_start > 0) & (time_left <= 0)
    return state._replace(truncated=(state.truncated | out_of_time) & ~state.terminated)


def episode_statistics(
    before: BatchState, state: EnvState
) -> tuple[Array, dict[str, Array], EpisodeSums]:
    """Adds the step that led to `state` [N] to the sums of `before`.

    Returns:
      Returns [N] and term sums [N] of the episodes that continue (zero where one ended), and the
      sums over the whole ones that ended.
    """
    over = state.terminated | state.truncated
    done = over & (before.head_start == 0)
    returns = before.return_sum + state.reward
    terms = {name: before.term_sums[name] + state.reward_terms[name] for name in before.term_sums}
    finished = EpisodeSums(
        count=done.sum(dtype=jnp.int32),
        return_sum=jnp.where(done, returns, 0.0).sum(),
        length_sum=jnp.where(done, state.steps, 0).sum(dtype=jnp.int32),
        term_sums={name: jnp.where(done, value, 0.0).sum() for name, value in terms.items()},
        metric_sums={
            name: jnp.where(done, value, 0.0).sum() for name, value in state.metrics.items()
        },
    )
    going_on = {name: jnp.where(over, 0.0, value) for name, value in terms.items()}
    return jnp.where(over, 0.0, returns), going_on, finished


def overflowed(env: Env, state: EnvState) -> dict[str, Array]:
    """For environments [N]: how many of them met a buffer that was too small, by `OVERFLOWS`."""
    if env.overflow is None:
        return {}
    counts = jnp.sum(jax.vmap(env.overflow)(state), axis=0, dtype=jnp.int32)
    return dict(zip(OVERFLOWS, counts, strict=True))


def head_starts(spec: EnvSpec, keys: PRNGKey) -> Array:
    """Steps [N] int32, at random up to a time limit, by which first episodes are shorter."""
    own = jax.vmap(lambda key: jax.random.fold_in(key, _HEAD_START))(keys)
    return jax.vmap(lambda key: jax.random.randint(key, (), 0, spec.episode_length))(own)


def step_output(
    env: Env, stepped: EnvState, bad: Mapping[str, Array], finished: EpisodeSums
) -> StepOutput:
    """What a step is for the caller.

    Args:
      env: of which the states are.
      stepped: the states [N] after it, before any reset.
      bad: [N] bool, which of them have diverged, by source.
      finished: see `StepOutput`.
    """
    return StepOutput(
        next_obs=stepped.obs,
        reward=stepped.reward,
        terminated=stepped.terminated,
        truncated=stepped.truncated,
        is_diverged=bad["any"],
        finished=finished,
        diverged={name: jnp.sum(where, dtype=jnp.int32) for name, where in bad.items()},
        overflowed=overflowed(env, stepped),
    )


def training_env(env: Env, *, random_ep_len: bool = False) -> BatchedEnv:
    """N auto-resetting copies of `env`, with statistics of the episodes that end.

    Args:
      env: one of them, with a time limit.
      random_ep_len: the first episode of an environment is as long as if it had begun before, by a
        random part of the time limit. Otherwise environments that do not end by themselves all end
        in the same step, and all samples of an update are of the same moment of an episode.

    `init` raises ConfigError for more environments than `env.max_envs`.
    """
    batched = vectorise(env)

    def init(model: PyTree, keys: PRNGKey) -> BatchState:
        if env.max_envs is not None and len(keys) > env.max_envs:
            raise ConfigError(
                f"num_envs={len(keys)}: {env.spec.name} was made for at most {env.max_envs}"
            )
        zero = jnp.zeros(keys.shape)
        terms = dict.fromkeys(env.spec.reward_terms, zero)
        starts = head_starts(env.spec, keys) if random_ep_len else jnp.zeros(keys.shape, jnp.int32)
        return BatchState(batched.reset(model, keys), zero, terms, starts)

    def advance(model: PyTree, state: BatchState, actions: Array) -> tuple[BatchState, StepOutput]:
        stepped = batched.step(model, state.env, actions)
        if random_ep_len:  # Else it changes nothing, and costs MJX-JAX 4 % of ant's iteration.
            stepped = cut_first_episodes(env.spec, state, stepped)
        bad = diverged_by_source(env, stepped)
        stepped = end_diverged(state.env, stepped, bad["any"])
        if env.next_episode is not None:  # What is carried on must be finite.
            kept = select_envs(bad["any"], state.env.task, stepped.task)
            stepped = stepped._replace(task=kept)
        returns, terms, finished = episode_statistics(state, stepped)
        output = step_output(env, stepped, bad, finished)
        ended = stepped.terminated | stepped.truncated
        head_start = jnp.where(ended, 0, state.head_start)
        return BatchState(stepped, returns, terms, head_start), output

    def restart(model: PyTree, state: BatchState) -> BatchState:
        return state._replace(env=auto_reset(batched, model, state.env))

    def step(model: PyTree, state: BatchState, actions: Array) -> tuple[BatchState, StepOutput]:
        after, output = advance(model, state, actions)
        return restart(model, after), output

    overflows = () if env.overflow is None else OVERFLOWS
    # Traced once for all programs with it; what they are made of stays the same.
    traced_once = jax.jit(step, inline=True)
    return BatchedEnv(env.spec, env.model, init, traced_once, advance, restart, overflows)


@partial(jax.jit, static_argnames="num_envs")
def env_keys(key: PRNGKey, first_env: int, num_envs: int) -> PRNGKey:
    """Keys [N] of environments `first_env` to `first_env + num_envs - 1` of a whole job.

    Args:
      key: the job's key, the same on every GMI.
      first_env: global number of this GMI's first environment.
      num_envs: N.
    """
    return jax.vmap(lambda env: jax.random.fold_in(key, env))(first_env + jnp.arange(num_envs))


def split_keys(state: BatchState) -> tuple[BatchState, PRNGKey]:
    """Draws one key [N] from every environment's own, for the policy's noise."""
    pairs = jax.vmap(jax.random.split)(state.env.key)
    return state._replace(env=state.env._replace(key=pairs[:, 0])), pairs[:, 1]
