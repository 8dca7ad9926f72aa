"""What the configuration puts around a task: a time limit, repeated actions, past observations.

Each takes one environment and returns one, on numpy as on JAX (`gmijax.arrays`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gmijax.arrays import array_module
from gmijax.sim.interface import Env, EnvState
from gmijax.types import Array, PRNGKey, PyTree


def time_limit(env: Env, episode_length: int) -> Env:
    """Truncates episodes after `episode_length` steps; an episode that ends by itself is not."""

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        state = env.step(model, state, action)
        out_of_time = state.steps >= episode_length
        return state._replace(
            truncated=(state.truncated | out_of_time) & ~state.terminated,
        )

    return env._replace(step=step, spec=env.spec._replace(episode_length=episode_length))


def action_repeat(env: Env, times: int) -> Env:
    """Takes every action for `times` of the task's own steps, fewer where the episode ends.

    The reward and its terms are summed; all else is as the last of these steps left it. Steps of
    the result are actions: it has `times` the seconds per step, and as many seconds per episode.

    Args:
      env: one environment with its time limit, which counts the task's own steps.
      times: steps per action; with 1 `env` itself is returned.
    """
    if times == 1:
        return env

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        def once(before: EnvState) -> EnvState:
            after = env.step(model, before, action)
            terms = {name: before.reward_terms[name] + x for name, x in after.reward_terms.items()}
            after = after._replace(reward=before.reward + after.reward, reward_terms=terms)
            return after

        xp = array_module(state.obs)
        zero, false = xp.zeros((), np.float32), xp.zeros((), bool)
        start = state._replace(
            reward=zero,
            reward_terms=dict.fromkeys(state.reward_terms, zero),
            terminated=false,
            truncated=false,
            # All actions before this one took all of their steps.
            steps=state.steps * times,
        )
        return _until_the_end(once, start, times)._replace(steps=state.steps + 1)

    spec = env.spec._replace(
        control_dt_s=env.spec.control_dt_s * times,
        episode_length=-(-env.spec.episode_length // times),
    )
    return env._replace(spec=spec, step=step)


def _until_the_end(once: Callable[[EnvState], EnvState], state: EnvState, times: int) -> EnvState:
    """The state after `times` of `once`, or after the one that ended the episode."""
    if array_module(state.obs) is np:
        for _ in range(times):
            state = state if state.terminated or state.truncated else once(state)
        return state
    import jax

    from gmijax.sim.wrappers import select_env

    def unless_ended(before: EnvState, _: None) -> tuple[EnvState, None]:
        ended = before.terminated | before.truncated
        return select_env(ended, before, once(before)), None

    return jax.lax.scan(unless_ended, state, length=times)[0]


def observation_history(env: Env, length: int) -> Env:
    """Observations [length x O] of the last `length` steps, the oldest first.

    At the start of an episode all of them are the first one. What only the value function sees
    (`EnvSpec.actor_obs_size`) is that of the last step alone, and stays at the end.

    Args:
      env: one environment.
      length: observations in one; with 1 `env` itself is returned.
    """
    if length == 1:
        return env
    size = env.spec.obs_size
    seen = env.spec.actor_obs_size or size
    past = (length - 1) * seen

    def fill(state: EnvState) -> EnvState:
        xp = array_module(state.obs)
        earlier = xp.tile(state.obs[:seen], length - 1)
        return state._replace(obs=xp.concatenate([earlier, state.obs]))

    def newest(state: EnvState) -> EnvState:
        return state._replace(obs=state.obs[past:])

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        return fill(env.reset(model, key))

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        after = env.step(model, newest(state), action)
        earlier = state.obs[seen : seen + past]
        return after._replace(obs=array_module(after.obs).concatenate([earlier, after.obs]))

    again = env.next_episode

    def next_episode(model: PyTree, ended: EnvState) -> EnvState:
        assert again is not None
        return fill(again(model, newest(ended)))

    return env._replace(
        spec=env.spec._replace(
            obs_size=past + size,
            obs_terms=env.spec.obs_terms * length if seen == size else (),
            actor_obs_size=None if env.spec.actor_obs_size is None else past + seen,
        ),
        reset=reset,
        step=step,
        next_episode=None if again is None else next_episode,
    )
