"""Repeated actions and past observations, and tasks that carry something on between episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import point_mass_env, walker
from training_jobs import POINT_TASK

from gmijax.cli.compose import compose
from gmijax.errors import ConfigError
from gmijax.sim.adapters.checks import check_env
from gmijax.sim.interaction import action_repeat, observation_history
from gmijax.sim.interface import EnvState
from gmijax.sim.randomize import make_envs
from gmijax.sim.wrappers import env_keys, training_env


def test_an_action_is_repeated_until_the_episode_ends():
    env = action_repeat(walker(), 2)
    assert (env.spec.control_dt_s, env.spec.episode_length) == (2.0, 50)
    start = env.reset(None, jax.random.key(0))
    step = jax.jit(env.step)
    first = step(None, start, jnp.array([0.5]))
    assert float(first.obs[0]) == pytest.approx(float(start.obs[0]) + 2.0)
    assert float(first.reward) == 2 * (1.0 + 5.0)
    assert {name: float(x) for name, x in first.reward_terms.items()} == {"walk": 2, "push": 10}
    assert (int(first.steps), bool(first.terminated)) == (1, False)
    # The third of the task's steps ends the episode: there is no fourth.
    second = step(None, first, jnp.array([-0.125]))
    assert float(second.obs[0]) == pytest.approx(float(start.obs[0]) + 3.0)
    assert (float(second.reward), int(second.steps)) == (-0.25, 2)
    assert bool(second.terminated)
    assert not second.truncated


def test_the_time_limit_counts_the_steps_of_the_task():
    env = action_repeat(walker(episode_length=3 - 2), 2)
    assert env.spec.episode_length == 1
    ended = env.step(None, env.reset(None, jax.random.key(0)), jnp.zeros(1))
    assert (float(ended.reward), bool(ended.truncated), bool(ended.terminated)) == (1, True, False)


def test_a_repeated_action_is_that_action_twice():
    env, action = point_mass_env(), jnp.array([0.7])
    state = env.reset(env.model, jax.random.key(3))
    once = env.step(env.model, state, action)
    twice = env.step(env.model, once, action)
    repeated = action_repeat(env, 2).step(env.model, state, action)
    assert float(repeated.reward) == pytest.approx(float(once.reward + twice.reward))
    expected = twice._replace(
        reward=repeated.reward, reward_terms=repeated.reward_terms, steps=jnp.int32(1)
    )
    jax.tree.map(np.testing.assert_array_equal, *(_bits(x) for x in (repeated, expected)))


def _bits(state: EnvState) -> EnvState:
    return state._replace(key=jax.random.key_data(state.key))


def test_past_observations_go_before_new_ones_and_a_start_fills_all():
    one = walker()
    one = one._replace(spec=one.spec._replace(obs_terms=(("position", 1),)))
    env = observation_history(one, 3)
    assert (env.spec.obs_size, env.spec.obs_terms) == (3, (("position", 1),) * 3)
    state = env.reset(None, jax.random.key(1))
    x = float(state.obs[0])
    assert state.obs.tolist() == pytest.approx([x, x, x])
    state = env.step(None, state, jnp.zeros(1))
    assert state.obs.tolist() == pytest.approx([x, x, x + 1])
    state = env.step(None, state, jnp.zeros(1))
    assert state.obs.tolist() == pytest.approx([x, x + 1, x + 2])


def test_what_only_the_value_function_sees_has_no_past():
    env = walker()

    def privileged(state: EnvState) -> EnvState:
        return state._replace(obs=jnp.append(state.obs, 100.0 + state.steps))

    def step(model: Any, state: EnvState, action: jax.Array) -> EnvState:
        return privileged(env.step(model, state._replace(obs=state.obs[:1]), action))

    env_of_both = env._replace(
        spec=env.spec._replace(obs_size=2, actor_obs_size=1),
        reset=lambda model, key: privileged(env.reset(model, key)),
        step=step,
    )
    history = observation_history(env_of_both, 3)
    assert (history.spec.obs_size, history.spec.actor_obs_size) == (4, 3)
    state = history.reset(None, jax.random.key(1))
    x = float(state.obs[0])
    for _ in range(2):
        state = history.step(None, state, jnp.zeros(1))
    assert state.obs.tolist() == pytest.approx([x, x + 1, x + 2, 102.0])


def test_the_configuration_puts_both_around_a_task(tmp_path: Path):
    (tmp_path / "point.py").write_text(POINT_TASK)
    overrides = (f"env={tmp_path}/point.py:make", "env.history=3", "env.action_repeat=2")
    env = make_envs(compose(*overrides).env, "jax", seed=0, first_env=0, num_envs=2)
    assert env.spec.obs_size == 6
    assert env.spec.control_dt_s == pytest.approx(0.2)
    assert env.spec.episode_length == 10
    check_env(env, "both")


def test_what_a_task_carries_on_survives_resets_and_bad_numbers():
    env = observation_history(walker(episode_length=2, carries=True), 2)
    check_env(env, "walker")
    batch = training_env(env)
    state, step = batch.init(None, env_keys(jax.random.key(0), 0, 3)), jax.jit(batch.step)
    # The third environment breaks in its second episode: it keeps the level of its first one.
    for broken in (0.0, 0.0, 2.0, 0.0, 0.0):
        before = state
        state, out = step(None, state, jnp.array([[0.0], [0.0], [broken]]))
        over = out.terminated | out.truncated
        again = np.asarray(state.env.obs)[np.asarray(over)]
        assert (again[:, 0] == again[:, 1]).all()
        assert (state.env.key != before.env.key)[over].all()
    assert state.env.task.level.tolist() == [2.0, 2.0, 2.0]
    assert float(out.finished.metric_sums["level"]) == 1.0
    plain = training_env(walker(episode_length=2))
    state = plain.init(None, env_keys(jax.random.key(0), 0, 3))
    for _ in range(4):
        state, _ = plain.step(None, state, jnp.zeros((3, 1)))
    assert state.env.task.level.tolist() == [0.0] * 3


def test_the_next_episode_must_be_as_the_first():
    env = walker(carries=True)
    bad = env._replace(next_episode=lambda model, ended: ended._replace(task=()))
    with pytest.raises(ConfigError, match=r"^walker: next_episode must give what reset does, but"):
        check_env(bad, "walker")
