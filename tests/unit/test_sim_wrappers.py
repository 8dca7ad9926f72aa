"""The wrappers on a task whose every number can be done in the head."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import walker

from gmijax.errors import ConfigError
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.wrappers import BatchedEnv, env_keys, split_keys, training_env

PUSH = 0.5


def compiled(env: Env, *, random_ep_len: bool = False) -> BatchedEnv:
    batched = training_env(env, random_ep_len=random_ep_len)
    return batched._replace(init=jax.jit(batched.init), step=jax.jit(batched.step))


@cache
def envs(episode_length: int) -> BatchedEnv:
    return compiled(walker(episode_length))


@cache
def envs_with_head_starts(episode_length: int) -> BatchedEnv:
    return compiled(walker(episode_length), random_ep_len=True)


def start(env: BatchedEnv, num_envs: int, first: int = 0, seed: int = 0) -> Any:
    return env.init(None, env_keys(jax.random.key(seed), first, num_envs))


def step(env: BatchedEnv, state: Any) -> Any:
    return env.step(None, state, jnp.full((*state.env.reward.shape, 1), PUSH))


def test_programs_with_the_same_environments_share_a_trace():
    calls = []
    task = walker(2)

    def counted(*arguments: Any) -> EnvState:
        calls.append(1)
        return task.step(*arguments)

    env = training_env(task._replace(step=counted))
    state, actions = start(env, 2), jnp.zeros((2, 1))
    for scale in (1.0, 2.0):
        jax.jit(lambda s, a, by=scale: env.step(None, s, by * a)).lower(state, actions)
    assert len(calls) == 1


def test_keys_of_environments_are_those_of_fold_in():
    key = jax.random.key(2**31 - 1)
    one_by_one = [jax.random.key_data(jax.random.fold_in(key, 2**30 + i)) for i in range(3)]
    np.testing.assert_array_equal(jax.random.key_data(env_keys(key, 2**30, 3)), one_by_one)


def test_time_limit_truncates_and_a_new_episode_begins_elsewhere():
    env = envs(2)
    first = start(env, 2)
    after, going_on = step(env, first)
    assert int(going_on.finished.count) == 0
    assert after.return_sum.tolist() == [6.0, 6.0]
    assert after.term_sums["push"].tolist() == [5.0, 5.0]
    state, out = step(env, after)
    assert [o.truncated.tolist() for o in (going_on, out)] == [[False] * 2, [True] * 2]
    assert not out.terminated.any()
    # Two environments, two steps of 1 + 5 each.
    finished = out.finished
    assert (int(finished.count), float(finished.return_sum)) == (2, 24.0)
    assert int(finished.length_sum) == 4
    assert {k: float(v) for k, v in finished.term_sums.items()} == {"walk": 4.0, "push": 20.0}
    # The outcome is of the old episode, the state of the new one.
    np.testing.assert_allclose(out.next_obs, first.env.obs + 2.0)
    assert (state.env.obs < 1.0).all()
    assert (state.env.obs != first.env.obs).all()
    assert state.return_sum.tolist() == [0.0, 0.0]
    assert state.env.steps.tolist() == [0, 0]


def test_two_halves_see_what_the_whole_sees():
    parts = []
    for first, count in ((0, 4), (0, 2), (2, 2)):
        state, noise_keys = split_keys(start(envs(2), count, first, seed=3))
        for _ in range(3):
            state, out = step(envs(2), state)
        head_start = start(envs_with_head_starts(1000), count, first, seed=3).head_start
        noise = jax.random.key_data(noise_keys)
        parts.append((out.next_obs, state.env.obs, noise, head_start))
    for whole, left, right in zip(*parts, strict=True):
        np.testing.assert_array_equal(whole, np.concatenate([left, right]))


def test_split_keys_never_hands_out_the_same_key_twice():
    state, first = split_keys(start(envs(2), 2))
    state, second = split_keys(state)
    drawn = np.concatenate([jax.random.key_data(keys) for keys in (first, second, state.env.key)])
    assert len(np.unique(drawn, axis=0)) == 6


def test_more_environments_than_the_model_was_made_for():
    env = training_env(walker(2)._replace(max_envs=2))
    with pytest.raises(ConfigError, match="num_envs=3: walker was made for at most 2"):
        start(env, 3)


def test_first_episodes_end_at_random_times_and_do_not_count():
    # It ends by itself after three steps: what is shorter was cut.
    env = envs_with_head_starts(3)
    state = start(env, 64)
    head_start = state.head_start
    assert set(head_start.tolist()) == {0, 1, 2}
    for number in (1, 2, 3):
        state, out = step(env, state)
        np.testing.assert_array_equal(out.truncated, (head_start == 3 - number) & (number < 3))
        np.testing.assert_array_equal(out.terminated, (number == 3) & (head_start == 0))
        assert int(out.finished.count) == int(out.terminated.sum())
    assert not state.head_start.any()
    assert state.env.steps.tolist() == head_start.tolist()


def test_environments_with_bad_numbers_end_without_reward_and_start_over():
    env = envs(100)
    state = start(env, 4)
    # A position of 1e7 is possible, an observation is not.
    position = jnp.array([0.0, jnp.nan, 1e12, 1e7])[:, None] - 1.0
    state = state._replace(env=state.env._replace(physics=position, obs=jnp.ones((4, 1))))
    after, out = step(env, state)
    assert out.terminated.tolist() == [False, True, True, True]
    np.testing.assert_array_equal(out.next_obs[1:], 1.0)
    assert out.reward.tolist() == [6.0, 0.0, 0.0, 0.0]
    assert {name: int(count) for name, count in out.diverged.items()} == {
        **{"any": 3, "physics": 2, "observation": 3, "reward/walk": 1, "reward/push": 0},
    }
    assert after.env.steps.tolist() == [1, 0, 0, 0]
    assert np.isfinite(after.env.obs).all()
    assert out.overflowed == {}  # There are no buffers that could be full.


def test_environments_that_met_a_full_buffer_are_counted_by_buffer():
    def overflow(state: EnvState) -> jax.Array:
        return jnp.stack([jnp.ones((), bool), state.obs[0] > 1.5])

    env = compiled(walker(100)._replace(overflow=overflow))
    _, out = step(env, start(env, 8))
    counts = {name: int(count) for name, count in out.overflowed.items()}
    assert counts == {"contact": 8, "constraint": int((out.next_obs[:, 0] > 1.5).sum())}
    assert 0 < counts["constraint"] < 8
