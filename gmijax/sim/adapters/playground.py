"""Environments of MuJoCo Playground: `env=playground env.name=CartpoleBalance`.

Playground clones the robot models of MuJoCo Menagerie from GitHub when a locomotion or
manipulation task is made for the first time. Its tasks of the dm_control suite need no network.
"""

from __future__ import annotations

import difflib
import importlib
import math
import subprocess
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.errors import ConfigError
from gmijax.sim.adapters.brax_interface import adapt
from gmijax.sim.adapters.checks import attempt
from gmijax.sim.impl import choose_impl
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.physics import which_overflowed
from gmijax.types import Array, PyTree


def make(name: str, *, impl: str = "auto", max_envs: int | None = None) -> Env:
    """Makes one of Playground's environments with its default configuration.

    Args:
      name: one of `mujoco_playground.registry.ALL_ENVS`.
      impl: `auto`, `jax` or `warp`.
      max_envs: most worlds at once; MJX-Warp's buffer of contacts is for so many.

    Raises:
      ConfigError: an unknown name, models that could not be downloaded, or one that
        Playground cannot make with the installed version of MuJoCo.
    """
    # By name: it is not installed where gmijax is checked.
    registry = attempt("env=playground", importlib.import_module, "mujoco_playground").registry
    if name not in registry.ALL_ENVS:
        raise ConfigError(_unknown(name, registry.ALL_ENVS))
    config = registry.get_default_config(name)
    if "impl" in config:
        config.impl, _ = choose_impl(impl, jax.default_backend(), f"playground/{name}")
        config.naconmax = math.ceil(config.naconmax * _growth(registry, name, max_envs))
    elif impl == "warp":
        raise ConfigError(f"physics.impl=warp: {name} has MJX-JAX only; allowed are auto, jax")
    theirs = attempt(f"env.name={name}", _load, registry, name, config)
    env = from_playground(theirs, name=f"playground/{name}", episode_length=config.episode_length)
    return env._replace(max_envs=max_envs) if env.overflow is not None else env


def _growth(registry: Any, name: str, max_envs: int | None) -> float:
    """How much larger a buffer for all worlds must be than theirs, which is for their training."""
    suites = ("locomotion", "manipulation", "dm_control_suite")
    suite = next((one for one in suites if name in getattr(registry, one).ALL_ENVS), None)
    if max_envs is None or suite is None:
        return 1.0
    settings = importlib.import_module(f"mujoco_playground.config.{suite}_params")
    return max(1.0, max_envs / settings.brax_ppo_config(name).num_envs)


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
    """An `MjxEnv`, without wrappers, as one of ours; see `brax_interface.adapt`.

    In MJX-Warp `theirs` is changed, see `without_warnings`.
    """
    is_warp = theirs.mjx_model.impl.value == "warp"
    env = adapt(
        without_warnings(theirs) if is_warp else theirs,
        name=name,
        episode_length=episode_length,
        mj_model=theirs.mj_model,
        qpos=lambda state: state.data.qpos,
    )
    return _with_overflow(env) if is_warp else env


def _with_overflow(env: Env) -> Env:
    """`env` in MJX-Warp, which tells of buffers that were too small in the last step."""

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        # MJX-Warp only ever adds bits.
        data = state.physics.data
        cleared = data.tree_replace({"_impl.overflow": jnp.zeros_like(data._impl.overflow)})
        return env.step(model, state._replace(physics=state.physics.replace(data=cleared)), action)

    def overflow(state: EnvState) -> Array:
        return which_overflowed(state.physics.data._impl.overflow)

    return env._replace(step=step, overflow=overflow)


def without_warnings(theirs: Any) -> Any:
    """`theirs` in MJX-Warp, changed not to print.

    Else there is a line for every world and step that reaches the limit of the solver's
    iterations, which their models mean to reach.
    """
    theirs._mjx_model = theirs.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
    return theirs


def _menagerie_folder() -> str:
    return str(importlib.import_module("mujoco_playground._src.mjx_env").MENAGERIE_PATH)


def _unknown(name: str, names: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}?" if close else "see mujoco_playground.registry.ALL_ENVS"
    return f"env.name={name}: Playground has no such environment: {hint}"
