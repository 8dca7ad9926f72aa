"""Tasks in files of the user's own: `env=path/to/file.py:make`."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.config.schema import suggestion
from gmijax.devices import require_32_bit
from gmijax.errors import ConfigError
from gmijax.runs.names import nearby
from gmijax.sim.adapters.checks import attempt, check_env, check_start
from gmijax.sim.adapters.neighbours import importable
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.source import split
from gmijax.sim.traced import traced_once

_DTYPES: Mapping[str, Any] = MappingProxyType(
    {
        "reward": jnp.float32,
        "reward_terms": jnp.float32,
        "metrics": jnp.float32,
        "terminated": jnp.bool_,
        "truncated": jnp.bool_,
        "steps": jnp.int32,
    }
)
"""Of the numbers of an `EnvState`."""


def make(
    name: str,
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    source_sha256: str | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
    curriculum: bool = False,
) -> Env:
    """Calls `FUNCTION(impl=..., max_envs=...)` of `PATH.py:FUNCTION`, and checks what it returns.

    With `source_sha256` a file of another digest is not executed. `rewards` and `settings` are
    handed on where they are not empty, `curriculum` where it is true.

    Raises:
      ConfigError: the file or the function cannot be loaded, it takes no such argument, it fails,
        or what it returns is no environment; one line, with the location.
    """
    path, function = split(name)
    changes = {"rewards": rewards, "settings": settings, "curriculum": curriculum}
    given = {key: value for key, value in changes.items() if value}
    what = f"env={path.name}:{function}"
    with importable(path.parent):
        module = attempt(f"env={nearby(path)}", load_module, path, source_sha256)
        found = getattr(module, function, None)
        if not callable(found):
            near = suggestion(function, _own_functions(module))
            raise ConfigError(f"env={nearby(Path(name))}: no function {function} there{near}")
        for group in given:
            _require_argument(found, group, what)
        env = attempt(what, found, impl=impl, max_envs=max_envs, **given)
        require_32_bit(what)
        if isinstance(env, Env):
            env = traced_once(_with_arrays(env))
        env = check_env(env, what)
        check_start(env, what)
    return env


def _own_functions(module: ModuleType) -> list[str]:
    """Names of the functions that a module defines, without those that it imports."""
    found = inspect.getmembers(module, inspect.isfunction)
    return [name for name, function in found if function.__module__ == module.__name__]


def _with_arrays(env: Env) -> Env:
    """The environment with arrays wherever its functions give numbers of Python or numpy.

    `~False` is -1 and `True + True` is 2, so what wraps an environment needs arrays.
    """
    again = env.next_episode and _arrays_of(env.next_episode)
    return env._replace(reset=_arrays_of(env.reset), step=_arrays_of(env.step), next_episode=again)


def _arrays_of(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        state = function(*arguments)
        if not isinstance(state, EnvState):
            return state
        for name, dtype in _DTYPES.items():
            convert = functools.partial(_array, dtype=dtype)
            state = state._replace(**{name: jax.tree.map(convert, getattr(state, name))})
        return jax.tree.map(_array, state)

    return call


def _array(leaf: Any, dtype: Any = None) -> Any:
    if not isinstance(leaf, bool | int | float | np.generic):
        return leaf
    return jnp.asarray(leaf, dtype or jnp.asarray(leaf).dtype)


def _require_argument(function: Callable[..., Any], group: str, what: str) -> None:
    kinds = inspect.signature(function).parameters
    takes_all = any(kind.kind is inspect.Parameter.VAR_KEYWORD for kind in kinds.values())
    if group not in kinds and not takes_all:
        raise ConfigError(f"env.{group}: {what} has no argument `{group}` to take it")


def load_module(path: Path, source_sha256: str | None) -> ModuleType:
    """Runs the file as a module."""
    text = path.read_bytes()
    if source_sha256 not in (None, hashlib.sha256(text).hexdigest()):
        raise ConfigError(f"env={nearby(path)}: has changed since the job was started")
    # A name of its own: a file called brax.py must not shadow a package.
    name = f"gmijax_custom_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"env={nearby(path)}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    # What the digest was taken of, and not what lies in __pycache__ or was written meanwhile.
    exec(compile(text, path, "exec"), vars(module))
    return module
