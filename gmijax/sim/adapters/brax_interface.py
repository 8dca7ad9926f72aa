"""An environment with the interface of Brax and MuJoCo Playground as one of ours.

Theirs is an object with `reset(rng) -> state` and `step(state, action) -> state`, whose states
have `obs`, `reward`, `done`, `metrics` and `info`. Time limit, automatic reset and statistics are
our wrappers' business, so theirs must come without wrappers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.errors import ConfigError
from gmijax.sim import episode
from gmijax.sim.adapters.checks import check_env
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.traced import inlined, traced_once
from gmijax.types import Array, PRNGKey, PyTree

POLICY_OBS, PRIVILEGED_OBS = "state", "privileged_state"
"""Entries of observations that are dicts, with Playground's names: the policy sees the first one,
the value function both."""

REWARD = "reward"
"""The one term of the reward: theirs come as a sum."""


WithModel = Callable[[PyTree], AbstractContextManager[None]]
"""Within it theirs has a model of ours."""


class Carried(NamedTuple):
    """What an environment takes from one episode to the next.

    Attributes:
      first: their state at the environment's first start, with an empty `info`.
      info: of their state now: what Brax's and Playground's automatic resets leave alone, such as
        the random key that new commands are drawn from.
    """

    first: Any
    info: Any


def no_model(theirs: Any, model: PyTree) -> AbstractContextManager[None]:
    """They keep their model to themselves, and ours is empty."""
    del theirs, model
    return nullcontext()


def adapt(
    theirs: Any,
    *,
    name: str,
    episode_length: int,
    mj_model: Any = None,
    qpos: Callable[[Any], Array] | None = None,
    with_model: Callable[[Any, PyTree], AbstractContextManager[None]] = no_model,
) -> Env:
    """Makes an `Env` of theirs.

    Observations that are dicts: the entry `state` where there is one, which the policy sees, and
    behind it `privileged_state`, which the value function sees too; else all entries in the order
    of their names. Scalars of `metrics` are summed over the episode, as Brax's `EpisodeWrapper`
    does. `done` terminates, unless `info["truncation"]` is set: time ran out.

    Args:
      theirs: one of their environments, without wrappers.
      name: for messages and logs.
      episode_length: steps after which an episode is truncated.
      mj_model: the MuJoCo model to film it with, None for no films.
      qpos: their state -> [nq], joint positions of that model; None for no films.
      with_model: `(theirs, model)`: within it theirs has the values of `model`, one of ours.

    Raises:
      ConfigError: observations that are no vectors, or a state that changes its shape.
    """
    own = partial(with_model, theirs)
    start_of = inlined(partial(_start, theirs, own))
    start = jax.eval_shape(start_of, (), jax.random.key_data(jax.random.key(0)))
    if mj_model is not None and (
        qpos is None or jax.eval_shape(qpos, start).shape != (mj_model.nq,)
    ):
        mj_model = qpos = None
    spec = _spec_of(theirs, start, name, episode_length)

    def positions(state: EnvState) -> Array:
        return jnp.zeros(0) if qpos is None else qpos(state.physics)

    reset, step = partial(_reset, start_of, spec), partial(_step, theirs, own)
    env = Env(spec, (), reset, step, mj_model, positions)
    env = traced_once(env._replace(next_episode=partial(_next_episode, spec)))
    check_env(env, f"env.name={name}")
    return env


def _spec_of(theirs: Any, start: Any, name: str, episode_length: int) -> EnvSpec:
    """By the shapes of their first state."""
    return EnvSpec(
        name=name,
        obs_size=_obs_size(start.obs, name),
        action_size=int(theirs.action_size),
        control_dt_s=float(getattr(theirs, "dt", math.nan)),
        episode_length=episode_length,
        reward_terms=(REWARD,),
        metrics=tuple(sorted(key for key, value in start.metrics.items() if value.shape == ())),
        actor_obs_size=_actor_obs_size(start.obs),
    )


def _start(theirs: Any, own: WithModel, model: PyTree, key_data: Array) -> Any:
    with own(model):
        return jax.tree.map(jnp.asarray, theirs.reset(key_data))


def _reset(
    start_of: Callable[[PyTree, Array], Any], spec: EnvSpec, model: PyTree, key: PRNGKey
) -> EnvState:
    key, draw = jax.random.split(key)
    # They were written for keys that are plain integers.
    state = start_of(model, jax.random.key_data(draw))
    first = state.replace(info={})
    return episode.begin(spec, first, Carried(first, state.info), observation(state.obs), key)


def _step(theirs: Any, own: WithModel, model: PyTree, state: EnvState, action: Array) -> EnvState:
    before = state.physics.replace(info=state.task.info)
    mine = jax.tree.map(lambda leaf: leaf, before)  # They write into their dicts.
    with own(model):
        after = _alike(before, theirs.step(mine, jnp.clip(action, -1.0, 1.0)))
    done = after.done > 0
    out_of_time = done & (jnp.asarray(after.info.get("truncation", 0)) > 0)
    reward = after.reward.astype(jnp.float32)
    sums = {
        key: total + after.metrics[key].astype(jnp.float32) for key, total in state.metrics.items()
    }
    obs, terms = observation(after.obs), (reward, {REWARD: reward})
    terminated = done & ~out_of_time
    physics, task = after.replace(info={}), state.task._replace(info=after.info)
    return episode.advance(state, physics, task, obs, terms, terminated, sums, out_of_time)


def _next_episode(spec: EnvSpec, model: PyTree, ended: EnvState) -> EnvState:
    """Back to the first start: a reset may cost as much as hundreds of steps."""
    del model
    first = ended.task.first
    return episode.begin(spec, first, ended.task, observation(first.obs), ended.key)


def observation(obs: Any) -> Array:
    """The vector [O] that is learnt from, with what the policy sees in front; see `adapt`."""
    return jnp.concatenate([jnp.ravel(part).astype(jnp.float32) for part in _parts(obs).values()])


def _parts(obs: Any) -> dict[str, Any]:
    if not (isinstance(obs, Mapping) and POLICY_OBS in obs):
        return _named(obs)
    privileged = {name: part for name, part in obs.items() if name == PRIVILEGED_OBS}
    return _named({POLICY_OBS: obs[POLICY_OBS]}) | _named(privileged)  # In this order.


def _named(obs: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(at): leaf for at, leaf in jax.tree.leaves_with_path(obs)}


def _actor_obs_size(obs: Any) -> int | None:
    if not (isinstance(obs, Mapping) and {POLICY_OBS, PRIVILEGED_OBS} <= obs.keys()):
        return None
    return sum(leaf.size for leaf in jax.tree.leaves(obs[POLICY_OBS]))


def _obs_size(obs: Any, name: str) -> int:
    for at, leaf in _parts(obs).items():
        if leaf.ndim > 1:
            raise ConfigError(
                f"env.name={name}: the observation{at} has shape {leaf.shape}; allowed: vectors"
            )
    return sum(leaf.size for leaf in _parts(obs).values())


def _alike(before: PyTree, after: PyTree) -> PyTree:
    """`after` with the dtypes of `before`: some of theirs return plain Python numbers."""
    if jax.tree.structure(before) != jax.tree.structure(after):
        return after  # `check_env` reports the difference.
    return jax.tree.map(_with_dtype, before, after)


def _with_dtype(before: Array, after: Any) -> Array:
    is_key = jnp.issubdtype(before.dtype, jax.dtypes.prng_key)
    return after if is_key else jnp.asarray(after, before.dtype)
