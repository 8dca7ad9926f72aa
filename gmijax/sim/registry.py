"""The tasks by name. Importing this module loads neither jax nor mujoco: the controller does."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from gmijax.errors import ConfigError

if TYPE_CHECKING:
    from gmijax.sim.interface import Env

TASKS: Mapping[str, str] = MappingProxyType(
    {
        "ant": "gmijax.sim.tasks.ant",
        "ball_balance": "gmijax.sim.tasks.ball_balance",
    }
)
"""Name -> module with `make(*, impl, max_envs) -> Env` and `DEFAULT_EPISODE_LENGTH`."""


def task_names() -> tuple[str, ...]:
    """All names that `make_env` knows, sorted."""
    return tuple(sorted(TASKS))


def require_task(name: str) -> None:
    """Raises ConfigError unless `name` is a task; needs no jax."""
    if name not in TASKS:
        raise ConfigError(f"env={name}: unknown task; allowed are {', '.join(task_names())}")


def make_env(
    name: str,
    *,
    impl: str = "auto",
    episode_length: int | None = None,
    max_envs: int | None = None,
) -> Env:
    """Makes a task, with its time limit.

    Args:
      name: one of `task_names()`.
      impl: MJX implementation, `auto`, `jax` or `warp`.
      episode_length: steps after which an episode is truncated; None: the task's own.
      max_envs: upper bound of environments stepped at once; only `warp` needs it, to size the
        contact buffer that they share. None: `gmijax.sim.physics.WARP_MAX_ENVS`.

    Raises:
      ConfigError: an unknown name, an implementation that cannot be had, or a length below 1.
    """
    require_task(name)
    if episode_length is not None and episode_length < 1:
        raise ConfigError(f"env.episode_length={episode_length}: must be at least 1")
    from gmijax.sim.wrappers import time_limit

    task = importlib.import_module(TASKS[name])
    env: Env = task.make(impl=impl, max_envs=max_envs)
    return time_limit(env, episode_length or task.DEFAULT_EPISODE_LENGTH)
