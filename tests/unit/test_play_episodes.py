"""Whole episodes on an environment that can be worked out by hand."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.cli.compose import compose
from gmijax.config import AlgoConfig
from gmijax.errors import ConfigError
from gmijax.learning import memory
from gmijax.learning.episodes import CHUNK_STEPS, EpisodeOptions, Episodes, run_episodes
from gmijax.learning.learner import init_learner, make_learner
from gmijax.sim import episode
from gmijax.sim.interaction import time_limit
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.types import Array, PRNGKey, PyTree

TIME_LIMIT = CHUNK_STEPS + 20
SPEC = EnvSpec("counter", 1, 1, 0.1, TIME_LIMIT, ("plus", "minus"))


def counting_env(reward: float = 1.0, per_action: float = 0.0) -> Env:
    """An environment that counts steps, earns `reward` and pays 0.25 a step, ends by chance.

    It earns `per_action` times the action too.
    """

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, draw = jax.random.split(key)
        end = jax.random.randint(draw, (), 5, 2 * TIME_LIMIT)
        return episode.begin(SPEC, jnp.zeros(1), end, jnp.zeros(1), key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        count = state.physics + 1.0
        terms = {"plus": reward + per_action * action[0], "minus": jnp.asarray(-0.25)}
        total = sum(terms.values(), jnp.zeros(()))
        ended = count[0] >= state.task
        return episode.advance(state, count, state.task, count / 100, (total, terms), ended)

    env = Env(SPEC, (), reset, step, None, lambda state: state.physics)
    return time_limit(env, TIME_LIMIT)


@pytest.fixture(scope="module")
def algo() -> AlgoConfig:
    return dataclasses.replace(
        compose().algo, policy_hidden_layer_sizes=(4,), value_hidden_layer_sizes=(4,)
    )


def episodes_of(algo: AlgoConfig, env: Env, **changes: object):
    learner = make_learner(SPEC, algo)
    state = init_learner(learner, SPEC.obs_size, jax.random.key(1))
    options = EpisodeOptions(num_envs=8, num_shown=3, seed=0, deterministic=True, max_steps=None)
    chunks: list[int] = []
    played = run_episodes(env, learner, state, options._replace(**changes), chunks.append)
    assert chunks == list(range(-(-int(played.lengths.max()) // CHUNK_STEPS) + 1))
    return played


@pytest.fixture(scope="module")
def played(algo: AlgoConfig) -> Episodes:
    return episodes_of(algo, counting_env())


def test_more_environments_than_memory_holds_are_refused_before_they_are_made(
    algo: AlgoConfig, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(memory, "memory_bytes", lambda: 64.0)
    wrong = r"^num_envs: 8 environments in one process .*; fewer than \d can fit"
    with pytest.raises(ConfigError, match=wrong):
        episodes_of(algo, counting_env())


def test_every_environment_plays_one_episode_and_no_more(played: Episodes):
    assert played.terminated.any()
    assert played.truncated.any()
    assert not played.diverged.any()
    # Each ended in exactly one way, and time ran out at the limit and nowhere else.
    assert (played.terminated ^ played.truncated).all()
    np.testing.assert_array_equal(played.lengths == TIME_LIMIT, played.truncated)
    np.testing.assert_allclose(played.returns, 0.75 * played.lengths)
    np.testing.assert_allclose(played.terms["plus"], played.lengths)
    np.testing.assert_allclose(played.terms["minus"], -0.25 * played.lengths)


def test_positions_go_from_start_to_the_longest_shown_end(played: Episodes):
    steps = np.arange(played.lengths[:3].max() + 1)[:, None]
    # The environment's one position is its step count, and it stands still after its end.
    np.testing.assert_array_equal(played.qpos[..., 0], np.minimum(steps, played.lengths[:3]))


def test_max_steps_cuts_episodes_off(algo: AlgoConfig):
    played = episodes_of(algo, counting_env(), max_steps=3)
    assert played.lengths.tolist() == [3] * 8
    assert not played.terminated.any()
    assert not played.truncated.any()


def test_environments_do_not_depend_on_how_many_there_are(algo: AlgoConfig):
    few = episodes_of(algo, counting_env(), num_envs=3, deterministic=False)
    many = episodes_of(algo, counting_env(), deterministic=False)
    np.testing.assert_array_equal(few.lengths, many.lengths[:3])


def test_a_seed_decides_what_random_actions_do(algo: AlgoConfig):
    env = counting_env(per_action=0.1)
    first, again = (episodes_of(algo, env, deterministic=False).returns for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first, episodes_of(algo, env).returns).any()


def test_an_environment_with_a_bad_number_ends_without_reward(algo: AlgoConfig):
    played = episodes_of(algo, counting_env(reward=float("nan")))
    assert played.diverged.all()
    assert played.terminated.all()
    assert played.lengths.tolist() == [1] * 8
    np.testing.assert_array_equal(played.returns, 0.0)
    # It is shown where it was last all right.
    np.testing.assert_array_equal(played.qpos, 0.0)
