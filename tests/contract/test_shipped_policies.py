"""The shipped policies are small, of every task, and do in plain MuJoCo what their results say."""

from __future__ import annotations

import math
from typing import Any

import pytest

from benchmarks.records import RESULTS, read_calls
from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.returns import play
from gmijax.player.shipped import POLICIES, shipped_policy, shipped_tasks
from gmijax.sim.registry import task_names

MOST_BYTES = 400_000
EPISODES = 4


def result_of(task: str) -> dict[str, Any]:
    """The newest result of a task."""
    found: dict[str, Any] = {}
    for path in sorted(RESULTS.glob("shipped-*.json")):
        for call in read_calls(path):
            found |= (call.results or {}).get(task, {})
    return found


def test_there_is_one_for_every_task():
    assert shipped_tasks() == task_names()


@pytest.mark.parametrize("task", shipped_tasks())
def test_it_is_small_and_fits_its_task(task: str):
    policy = shipped_policy(task)
    env = PlainEnv(task_of(policy))
    assert (POLICIES / f"{task}.npz").stat().st_size < MOST_BYTES
    assert env.spec.name == task
    assert policy.obs_size == (env.spec.actor_obs_size or env.spec.obs_size)
    assert policy.action_size == env.spec.action_size


@pytest.mark.parametrize("task", shipped_tasks())
def test_it_does_what_its_result_says(task: str):
    result = result_of(task)
    assert result["bytes"] == (POLICIES / f"{task}.npz").stat().st_size
    wanted, spread = result["mujoco"]["return"], result["mujoco"]["return_std"]
    returns = [one.return_ for one in play(shipped_policy(task), EPISODES, seed=1)]
    # The same seed and machine would give the first of the result's own episodes.
    assert abs(sum(returns) / EPISODES - wanted) < 4 * spread / math.sqrt(EPISODES) + 1e-3
