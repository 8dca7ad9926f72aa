"""Environments of MuJoCo Playground: `env=playground env.name=CartpoleBalance`.

Playground clones the robot models of MuJoCo Menagerie from GitHub when a locomotion or
manipulation task is made for the first time. Its tasks of the dm_control suite need no network.
"""

from __future__ import annotations

import difflib
import importlib
import subprocess
from typing import Any

from gmijax.errors import ConfigError
from gmijax.sim.adapters.brax_interface import adapt, require_jax
from gmijax.sim.adapters.checks import attempt
from gmijax.sim.interface import Env


def make(name: str, *, impl: str = "auto", max_envs: int | None = None) -> Env:
    """Makes one of Playground's environments with its default configuration, in MJX-JAX.

    Raises:
      ConfigError: an unknown name, MJX-Warp, models that could not be downloaded, or one that
        Playground cannot make with the installed version of MuJoCo.
    """
    del max_envs  # MJX-JAX has no limit.
    require_jax(impl, "Playground")
    # By name: it is not installed where gmijax is checked.
    registry = attempt("env=playground", importlib.import_module, "mujoco_playground").registry
    if name not in registry.ALL_ENVS:
        raise ConfigError(_unknown(name, registry.ALL_ENVS))
    config = registry.get_default_config(name)
    if "impl" in config:
        config.impl = "jax"
    theirs = attempt(f"env.name={name}", _load, registry, name, config)
    return from_playground(theirs, name=f"playground/{name}", episode_length=config.episode_length)


def _load(registry: Any, name: str, config: Any) -> Any:
    try:
        return registry.load(name, config=config)
    except (OSError, subprocess.CalledProcessError) as error:
        raise ConfigError(
            f"env.name={name}: Playground could not download its robot models to "
            f"{_menagerie_folder()}: make the task once where git reaches GitHub, or copy that "
            "folder here; the dm_control tasks need none"
        ) from error


def from_playground(theirs: Any, *, name: str, episode_length: int = 1000) -> Env:
    """An `MjxEnv`, without wrappers, as one of ours; see `brax_interface.adapt`."""
    return adapt(
        theirs,
        name=name,
        episode_length=episode_length,
        mj_model=theirs.mj_model,
        qpos=lambda state: state.data.qpos,
    )


def _menagerie_folder() -> str:
    return str(importlib.import_module("mujoco_playground._src.mjx_env").MENAGERIE_PATH)


def _unknown(name: str, names: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}?" if close else "see mujoco_playground.registry.ALL_ENVS"
    return f"env.name={name}: Playground has no such environment: {hint}"
