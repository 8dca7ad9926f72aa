"""Registers our tasks in Gymnasium: `gymnasium.make_vec("gmijax.gymnasium:gmijax/ant", 4096)`.

Importing this module registers `gmijax/<task>` for each of them. Gymnasium imports it by itself
for ids that begin with `gmijax.gymnasium:`.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from gmijax.list_envs import task_of
from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
from gmijax.sim.adapters.to_gymnasium_env import GmijaxEnv
from gmijax.sim.registry import task_names
from gmijax.sim.vector_envs import make_vector_env


def make_vec(
    num_envs: int, task: str, max_episode_steps: int | None = None, **options: Any
) -> GmijaxVectorEnv:
    """What `gymnasium.make_vec` calls; `options` are those of `gmijax.make_vector_env`."""
    return make_vector_env(task, num_envs, episode_length=max_episode_steps, **options)


def make(task: str, **options: Any) -> GmijaxEnv:
    """What `gymnasium.make` calls; it sets the time limit."""
    return GmijaxEnv(make_vector_env(task, 1, autoreset="disabled", **options))


def register() -> None:
    """Registers all of our tasks that are not registered."""
    for task in task_names():
        if (name := f"gmijax/{task}") not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make",
                vector_entry_point=f"{__name__}:make_vec",
                max_episode_steps=task_of(task).episode_length,
                kwargs={"task": task},
            )


register()
