"""Our tasks by the ids of Gymnasium."""

from __future__ import annotations

import importlib
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from toy_env import point_mass_env

from gmijax.sim import vector_envs
from gmijax.sim.interaction import time_limit
from gmijax.sim.registry import TASKS

ID = "gmijax.gymnasium:gmijax/ball_balance"


@pytest.fixture(autouse=True)
def toy_in_place_of_physics(monkeypatch: pytest.MonkeyPatch) -> None:
    def make_env(name: str, *, episode_length: int | None, **_: Any) -> Any:
        assert name == "ball_balance"
        env = point_mass_env(500)
        return time_limit(env, episode_length or env.spec.episode_length)

    monkeypatch.setattr(vector_envs, "make_env", make_env)


def test_an_id_needs_no_import_of_ours():
    # Refused before any physics is made.
    code = f"import gymnasium; gymnasium.make_vec({ID!r}, num_envs=0)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "ConfigError: num_envs=0: must be at least 1" in done.stderr


def test_every_task_is_registered_once_with_its_time_limit():
    ours = importlib.import_module("gmijax.gymnasium")
    ours.register()  # Warnings are errors, and of a second registration there is one.
    for task, module in TASKS.items():
        limit = importlib.import_module(module).DEFAULT_EPISODE_LENGTH
        assert gym.spec(f"gmijax/{task}").max_episode_steps == limit


def test_many_environments_by_id():
    envs: Any = gym.make_vec(ID, num_envs=3, autoreset="next_step")
    assert envs.num_envs == 3
    assert envs.metadata["autoreset_mode"] is gym.vector.AutoresetMode.NEXT_STEP
    assert envs.unwrapped.spec is not None
    assert envs.unwrapped.spec.max_episode_steps == envs.unwrapped.episode_length == 500
    shorter: Any = gym.make_vec(ID, num_envs=3, max_episode_steps=2)
    shorter.reset(seed=0)
    shorter.step(np.zeros((3, 1)))
    assert shorter.step(np.zeros((3, 1)))[3].all()


@pytest.mark.filterwarnings("ignore:.*observation space (min|max)imum value is -?infinity")
def test_one_environment_by_id_passes_the_checker_of_gymnasium():
    env = gym.make(ID, max_episode_steps=4)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    ended = [env.step(np.zeros(1, np.float32))[3] for _ in range(4)]
    assert ended == [False, False, False, True]
