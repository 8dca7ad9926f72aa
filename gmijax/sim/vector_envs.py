"""Our tasks in the vector interfaces of other libraries. Imports neither jax nor mujoco."""

from __future__ import annotations

import importlib
import importlib.util
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, overload

from gmijax.errors import ConfigError
from gmijax.machine.opengl import why_no_opengl
from gmijax.sim.registry import make_env, warn_on_cpu, whole_number

if TYPE_CHECKING:
    from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
    from gmijax.sim.adapters.to_rsl_rl import RslRlVecEnv
    from gmijax.sim.adapters.to_sb3 import Sb3VecEnv

_ARRAYS = ("numpy", "torch", "jax")
_AUTORESETS = ("same_step", "next_step", "disabled")
_RENDER_MODES = (None, "rgb_array")

# What each interface needs beside gymnasium: the module, and what to install.
_PACKAGES = MappingProxyType(
    {
        "gymnasium": {},
        "sb3": {"stable_baselines3": "stable-baselines3"},
        "rsl_rl": {"rsl_rl": "rsl-rl-lib"},
    }
)
# The only arrays that an interface has.
_OWN_ARRAYS = MappingProxyType({"sb3": "numpy", "rsl_rl": "torch"})


@overload
def make_vector_env(
    name: str,
    num_envs: int,
    *,
    api: Literal["gymnasium"] = ...,
    arrays: Literal["numpy", "torch", "jax"] | None = ...,
    autoreset: Literal["same_step", "next_step", "disabled"] | None = ...,
    render_mode: Literal["rgb_array"] | None = ...,
    suite: str = ...,
    impl: str = ...,
    episode_length: int | None = ...,
) -> GmijaxVectorEnv: ...


@overload
def make_vector_env(
    name: str,
    num_envs: int,
    *,
    api: Literal["sb3"],
    render_mode: Literal["rgb_array"] | None = ...,
    suite: str = ...,
    impl: str = ...,
    episode_length: int | None = ...,
) -> Sb3VecEnv: ...


@overload
def make_vector_env(
    name: str,
    num_envs: int,
    *,
    api: Literal["rsl_rl"],
    suite: str = ...,
    impl: str = ...,
    episode_length: int | None = ...,
) -> RslRlVecEnv: ...


def make_vector_env(
    name: str,
    num_envs: int,
    *,
    api: Literal["gymnasium", "sb3", "rsl_rl"] = "gymnasium",
    arrays: Literal["numpy", "torch", "jax"] | None = None,
    autoreset: Literal["same_step", "next_step", "disabled"] | None = None,
    render_mode: Literal["rgb_array"] | None = None,
    suite: str = "gmijax",
    impl: str = "auto",
    episode_length: int | None = None,
) -> Any:
    """Makes N environments in the interface of another library, for training with it.

    Examples:
      >>> envs = make_vector_env("ant", 4096, arrays="torch")
      >>> obs, info = envs.reset(seed=0)

    Args:
      name: see `make_env`.
      num_envs: N.
      api: `gymnasium` for a `gymnasium.vector.VectorEnv`, `sb3` for a `VecEnv` of
        Stable-Baselines3, `rsl_rl` for one of rsl_rl.
      arrays: what goes in and comes out, of `gymnasium` only: `numpy` (default), `torch`, on the
        GPU of jax without a copy (DLPack) where both use one, or `jax`.
      autoreset: when an environment that has ended starts over, of `gymnasium` only: `same_step`
        (default), `next_step`, which its wrappers of observations want, or `disabled`.
      render_mode: `rgb_array` for pictures of all environments by `render()`, not of `rsl_rl`;
        needs OpenGL.
      suite: see `make_env`.
      impl: see `make_env`.
      episode_length: see `make_env`.

    Returns:
      Of `gymnasium` a `gmijax.sim.adapters.to_gymnasium.GmijaxVectorEnv`.

    Raises:
      ConfigError: as `make_env`; `num_envs` below 1; a value that is not allowed, or not with
        this `api`; a package that is not installed; pictures where nothing can be drawn.
    """
    num_envs = whole_number("num_envs", num_envs)
    _require_options(api, arrays, autoreset, render_mode)
    own = _OWN_ARRAYS.get(api)
    chosen = own or arrays or "numpy"
    _require_packages(api, chosen)
    if render_mode is not None and (why_not := why_no_opengl()) is not None:
        raise ConfigError(f"render_mode={render_mode}: {why_not}")
    env = make_env(name, suite=suite, impl=impl, episode_length=episode_length, max_envs=num_envs)
    warn_on_cpu(env)
    module = importlib.import_module(f"gmijax.sim.adapters.to_{api}")
    options = {"arrays": chosen, "autoreset": autoreset or "same_step"} if own is None else {}
    if render_mode is not None:
        options["render_mode"] = render_mode
    return module.make(env, num_envs, **options)


def _require_options(
    api: str, arrays: str | None, autoreset: str | None, render_mode: str | None
) -> None:
    """Refuses values that are not allowed, or not with this `api`."""
    _require("api", api, tuple(_PACKAGES))
    _require("arrays", arrays, (None, *_ARRAYS))
    _require("autoreset", autoreset, (None, *_AUTORESETS))
    _require("render_mode", render_mode, _RENDER_MODES)
    own = _OWN_ARRAYS.get(api)
    if own is not None and (arrays not in (None, own) or autoreset not in (None, "same_step")):
        raise ConfigError(f"api={api}: its arrays are of {own}, its autoreset is same_step")
    if api == "rsl_rl" and render_mode is not None:
        raise ConfigError("render_mode=rgb_array: not with api=rsl_rl, which has no pictures")


def _require(key: str, value: Any, allowed: tuple[Any, ...]) -> None:
    if value not in allowed:
        names = ", ".join(str(one) for one in allowed if one is not None)
        raise ConfigError(f"{key}={value}: expected one of {names}")


def _require_packages(api: str, arrays: str) -> None:
    if importlib.util.find_spec("gymnasium") is None:
        raise ConfigError("make_vector_env: needs gymnasium (pip install 'gmijax[gymnasium]')")
    for module, distribution in _PACKAGES[api].items():
        if importlib.util.find_spec(module) is None:
            raise ConfigError(f"api={api}: needs {distribution} (pip install {distribution})")
    if importlib.util.find_spec(arrays) is None:
        raise ConfigError(f"arrays={arrays}: needs {arrays} (pip install {arrays})")
