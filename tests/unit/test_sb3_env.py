"""Our environments as Stable-Baselines3 steps them; with a stand-in where it is not installed."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from typing import Any

import fake_sb3
import numpy as np
import pytest
from toy_env import point_mass_env, walker

NUM_ENVS, LENGTH = 4, 5
STILL = np.zeros((NUM_ENVS, 1), np.float32)


@pytest.fixture(scope="module")
def bridge() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        if importlib.util.find_spec("stable_baselines3") is None:
            fake_sb3.install(patch)
        yield importlib.import_module("gmijax.sim.adapters.to_sb3")
    sys.modules.pop("gmijax.sim.adapters.to_sb3", None)


@pytest.fixture(scope="module")
def envs(bridge: Any) -> Any:
    return bridge.make(point_mass_env(LENGTH), NUM_ENVS)


def test_the_end_of_an_episode_is_reported_as_by_a_monitor(envs: Any):
    envs.seed(3)
    start = envs.reset()
    total = np.zeros(NUM_ENVS)
    for _ in range(LENGTH - 1):
        obs, reward, done, infos = envs.step(STILL)
        total += reward
        assert not done.any()
        assert infos == [{}] * NUM_ENVS
    obs, reward, done, infos = envs.step(STILL)
    total += reward
    assert done.all()
    for index, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        np.testing.assert_array_equal(info["terminal_observation"], start[index])
        assert info["episode"]["r"] == pytest.approx(total[index], rel=1e-5)
        assert info["episode"]["l"] == LENGTH
        # As its algorithms bootstrap: into our array.
        reward[index] += 0.99 * 1.0
    assert (obs != start).any(axis=1).all()


def test_a_seed_counts_for_the_next_reset_alone(envs: Any):
    envs.seed(3)
    first, second = envs.reset(), envs.reset()
    envs.seed(3)
    np.testing.assert_array_equal(first, envs.reset())
    assert (first != second).any()


def test_an_environment_that_falls_over_is_not_cut_by_time(bridge: Any):
    envs = bridge.make(walker(9), 2)
    envs.reset()
    for _ in range(2):
        _, _, done, infos = envs.step(np.array([[0.0], [np.nan]], np.float32))
        assert done.tolist() == [False, True]
        assert infos[1]["is_diverged"]
    _, _, done, infos = envs.step(np.zeros((2, 1), np.float32))
    assert done.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["episode"]["l"] == 3
    assert not infos[0]["is_diverged"]


def test_environments_are_no_objects(bridge: Any, envs: Any):
    assert envs.get_attr("episode_length") == [LENGTH] * NUM_ENVS
    assert envs.get_attr("episode_length", [0, 2]) == [LENGTH] * 2
    assert envs.env_is_wrapped(bridge.Monitor) == [True] * NUM_ENVS
    assert envs.env_is_wrapped(dict, [1]) == [False]
    with pytest.raises(AttributeError, match="gravity"):
        envs.set_attr("gravity", 1.0)
    with pytest.raises(AttributeError, match="jump"):
        envs.env_method("jump")
