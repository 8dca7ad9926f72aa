"""Our environments with the vector interface of Gymnasium."""

from __future__ import annotations

import importlib.util
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from toy_env import point_mass_env

from gmijax.errors import ConfigError
from gmijax.sim.adapters.to_gymnasium import vector_env
from gmijax.sim.registry import make_vector_env

NUM_ENVS, LENGTH = 4, 5


@pytest.fixture(scope="module")
def envs() -> VectorEnv[Any, Any, Any]:
    return vector_env(point_mass_env(LENGTH), NUM_ENVS, "numpy")


def random_actions(envs: VectorEnv[Any, Any, Any], seed: int) -> np.ndarray:
    envs.action_space.seed(seed)
    return envs.action_space.sample()


def test_shapes_and_types_are_those_of_the_spaces(envs: VectorEnv[Any, Any, Any]):
    obs, info = envs.reset(seed=0)
    assert envs.num_envs == NUM_ENVS
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (envs.single_observation_space.shape, envs.single_action_space.shape) == ((2,), (1,))
    assert info == {}
    assert obs in envs.observation_space
    obs, reward, terminated, truncated, info = envs.step(random_actions(envs, 0))
    assert obs in envs.observation_space
    assert info["final_obs"] in envs.observation_space
    assert (reward.shape, reward.dtype) == ((NUM_ENVS,), np.float32)
    for flags in (terminated, truncated, info["_final_obs"]):
        assert isinstance(flags, np.ndarray)
        assert (flags.shape, flags.dtype) == ((NUM_ENVS,), np.bool_)


def test_a_world_starts_over_in_the_step_that_ends_its_episode(envs: VectorEnv[Any, Any, Any]):
    envs.reset(seed=0)
    still = np.zeros((NUM_ENVS, 1), np.float32)
    for step in range(1, 2 * LENGTH + 1):
        obs, _, terminated, truncated, info = envs.step(still)
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step % LENGTH == 0)
        assert (info["_final_obs"] == truncated).all()
        # A point that is not pushed stays where it is; a new episode begins elsewhere.
        assert (obs == info["final_obs"]).all() == (not truncated.any())


def test_a_seed_decides_the_episodes_and_none_draws_others(envs: VectorEnv[Any, Any, Any]):
    first, again = envs.reset(seed=3)[0], envs.reset(seed=3)[0]
    other, later = envs.reset(seed=4)[0], envs.reset()[0]
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.stack([first, other, later]), axis=0)) == 3
    assert len(np.unique(first, axis=0)) == NUM_ENVS


def test_wrappers_of_gymnasium_fit(envs: VectorEnv[Any, Any, Any]):
    counted = RecordEpisodeStatistics(envs)
    counted.reset(seed=0)
    total = np.zeros(NUM_ENVS)
    for step in range(LENGTH):
        _, reward, _, _, info = counted.step(random_actions(envs, step))
        total += reward
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    assert (info["episode"]["l"] == LENGTH).all()


def test_misuse_is_told(envs: VectorEnv[Any, Any, Any]):
    env = point_mass_env(LENGTH)
    # As one of Brax that does not say how long a step is.
    fresh = vector_env(
        env._replace(spec=env.spec._replace(control_dt_s=math.nan)), NUM_ENVS, "jax"
    )
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        fresh.step(np.zeros((NUM_ENVS, 1)))
    envs.reset(seed=0)
    with pytest.raises(gym.error.InvalidAction, match=r"\(4, 2\): expected \(4, 1\)"):
        envs.step(np.zeros((NUM_ENVS, 2), np.float32))


@pytest.mark.parametrize(
    ("num_envs", "arrays", "message"),
    [
        (0, "numpy", "num_envs=0: must be at least 1"),
        (4, "cupy", "arrays=cupy: allowed are numpy, torch, jax"),
        (4, "numpy", r"pip install 'gmijax\[gymnasium\]'"),
    ],
)
def test_bad_input_or_a_package_that_is_missing_is_told(
    num_envs: int, arrays: Any, message: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=message):
        make_vector_env("ant", num_envs, arrays=arrays)


def test_arrays_of_torch():
    torch = pytest.importorskip("torch")
    envs = vector_env(point_mass_env(LENGTH), NUM_ENVS, "torch")
    obs, _ = envs.reset(seed=0)
    assert isinstance(obs, torch.Tensor)
    obs, reward, terminated, _, info = envs.step(torch.zeros((NUM_ENVS, 1)))
    assert terminated.dtype == info["_final_obs"].dtype == torch.bool
    assert reward.dtype == torch.float32
    torch.testing.assert_close(obs, info["final_obs"])
