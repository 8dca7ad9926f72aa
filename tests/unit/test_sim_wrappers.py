"""The wrappers on a task whose every number can be done in the head.

The toy walks one unit per step from a random start in [0, 1), and falls over at 3 or more. Its
reward is 1 for walking plus 10 times the action.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.errors import ConfigError
from gmijax.sim import episode
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.wrappers import env_keys, split_keys, time_limit, training_env

SPEC = EnvSpec("toy", 1, 1, 1.0, 100, ("walk", "push"))


def toy(episode_length: int, max_envs: int | None = None) -> Env:
    def reset(model: None, key: jax.Array) -> EnvState:
        key, draw = jax.random.split(key)
        position = jax.random.uniform(draw, (1,))
        return episode.begin(SPEC, position, (), position, key)

    def step(model: None, state: EnvState, action: jax.Array) -> EnvState:
        position = state.physics + 1.0
        terms = {"walk": jnp.ones(()), "push": 10.0 * action[0]}
        reward = terms["walk"] + terms["push"], terms
        return episode.advance(state, position, (), position, reward, position[0] >= 3.0)

    env = Env(SPEC, None, reset, step, None, lambda state: state.physics, max_envs)
    return time_limit(env, episode_length)


def run(episode_length: int, steps: int, num_envs: int = 2):
    env = training_env(toy(episode_length))
    state = env.init(None, env_keys(jax.random.key(0), 0, num_envs))
    outputs = []
    for _ in range(steps):
        state, out = env.step(None, state, jnp.full((num_envs, 1), 0.5))
        outputs.append(out)
    return state, outputs


def test_time_limit_truncates_and_statistics_are_of_the_finished_episodes():
    state, outputs = run(episode_length=2, steps=2)
    assert [out.truncated.tolist() for out in outputs] == [[False] * 2, [True] * 2]
    assert not any(out.terminated.any() for out in outputs)
    # Two environments, two steps of 1 + 5 each.
    finished = outputs[1].finished
    assert (int(finished.count), float(finished.return_sum)) == (2, 24.0)
    assert int(finished.length_sum) == 4
    assert {k: float(v) for k, v in finished.term_sums.items()} == {"walk": 4.0, "push": 20.0}
    assert int(outputs[0].finished.count) == 0
    assert state.return_sum.tolist() == [0.0, 0.0]
    assert state.env.steps.tolist() == [0, 0]


def test_an_episode_that_ends_by_itself_at_the_limit_is_not_truncated():
    _, outputs = run(episode_length=3, steps=3)
    assert outputs[2].terminated.all()
    assert not outputs[2].truncated.any()


def test_outcome_is_the_old_episode_and_the_new_one_starts_elsewhere():
    state, outputs = run(episode_length=2, steps=2)
    first = training_env(toy(2)).init(None, env_keys(jax.random.key(0), 0, 2))
    np.testing.assert_allclose(outputs[1].next_obs, first.env.obs + 2.0)
    assert (state.env.obs < 1.0).all()
    assert (state.env.obs != first.env.obs).all()


def test_running_sums_go_on_until_the_episode_ends():
    state, _ = run(episode_length=5, steps=2)
    assert state.return_sum.tolist() == [12.0, 12.0]
    assert state.term_sums["push"].tolist() == [10.0, 10.0]
    assert state.env.steps.tolist() == [2, 2]


def test_two_halves_see_what_the_whole_sees():
    key = jax.random.key(3)
    env = training_env(toy(2))
    parts = []
    for first, count in ((0, 4), (0, 2), (2, 2)):
        state = env.init(None, env_keys(key, first, count))
        state, noise_keys = split_keys(state)
        for _ in range(2):
            state, _ = env.step(None, state, jnp.zeros((count, 1)))
        state, out = env.step(None, state, jnp.zeros((count, 1)))
        parts.append((out.next_obs, state.env.obs, jax.random.key_data(noise_keys)))
    for whole, left, right in zip(*parts, strict=True):
        np.testing.assert_array_equal(whole, np.concatenate([left, right]))


def test_split_keys_never_hands_out_the_same_key_twice():
    state = training_env(toy(2)).init(None, env_keys(jax.random.key(0), 0, 3))
    state, first = split_keys(state)
    state, second = split_keys(state)
    drawn = np.concatenate([jax.random.key_data(keys) for keys in (first, second, state.env.key)])
    assert len(np.unique(drawn, axis=0)) == 9


def test_more_environments_than_the_model_was_made_for():
    env = training_env(toy(2, max_envs=2))
    with pytest.raises(ConfigError, match="num_envs=3: toy was made for at most 2"):
        env.init(None, env_keys(jax.random.key(0), 0, 3))


def test_first_episodes_end_at_random_times_and_do_not_count():
    # The toy ends by itself after three steps: what is shorter was cut.
    env = training_env(toy(3), random_ep_len=True)
    state = env.init(None, env_keys(jax.random.key(0), 0, 64))
    head_start = state.head_start
    assert set(head_start.tolist()) == {0, 1, 2}
    for step in (1, 2, 3):
        state, out = env.step(None, state, jnp.zeros((64, 1)))
        np.testing.assert_array_equal(out.truncated, (head_start == 3 - step) & (step < 3))
        np.testing.assert_array_equal(out.terminated, (step == 3) & (head_start == 0))
        assert int(out.finished.count) == int(out.terminated.sum())
    assert not state.head_start.any()
    assert state.env.steps.tolist() == head_start.tolist()


def test_an_episode_that_ends_by_itself_with_a_head_start_does_not_count():
    env = training_env(toy(1000), random_ep_len=True)
    state = env.init(None, env_keys(jax.random.key(0), 0, 8))
    assert (state.head_start > 0).all()
    for count in (0, 8):
        for _ in range(3):
            state, out = env.step(None, state, jnp.zeros((8, 1)))
        assert out.terminated.all()
        assert int(out.finished.count) == count


def test_head_starts_are_those_of_the_world_whoever_has_it():
    env = training_env(toy(1000), random_ep_len=True)
    whole, left, right = (
        env.init(None, env_keys(jax.random.key(3), first, count)).head_start
        for first, count in ((0, 4), (0, 2), (2, 2))
    )
    np.testing.assert_array_equal(whole, np.concatenate([left, right]))
