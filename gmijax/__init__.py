"""gmijax: reinforcement learning in several GPU multiplexing instances (GMIs) on every GPU.

The names below are loaded when they are first used: `import gmijax` itself loads neither jax
nor mujoco.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from gmijax.version import __version__

if TYPE_CHECKING:
    from gmijax.cli.compose import compose
    from gmijax.control.job import Result, train
    from gmijax.control.searching import search
    from gmijax.control.serving import Served, serve
    from gmijax.deploy.policy import load_policy
    from gmijax.packs.pack import pack
    from gmijax.roles.launch import launch
    from gmijax.roles.manager import GMIManager, plan
    from gmijax.roles.role import Role
    from gmijax.sim.registry import make_env, task_names
    from gmijax.sim.vector_envs import make_vector_env
    from gmijax.sweeps.runner import SweepResult
    from gmijax.sweeps.sweep import sweep

__all__ = [
    "GMIManager",
    "Result",
    "Role",
    "Served",
    "SweepResult",
    "__version__",
    "compose",
    "launch",
    "load_policy",
    "make_env",
    "make_vector_env",
    "pack",
    "plan",
    "search",
    "serve",
    "sweep",
    "task_names",
    "train",
]

_HOMES = {
    "GMIManager": "gmijax.roles.manager",
    "Result": "gmijax.control.job",
    "Role": "gmijax.roles.role",
    "Served": "gmijax.control.serving",
    "SweepResult": "gmijax.sweeps.runner",
    "compose": "gmijax.cli.compose",
    "launch": "gmijax.roles.launch",
    "load_policy": "gmijax.deploy.policy",
    "make_env": "gmijax.sim.registry",
    "make_vector_env": "gmijax.sim.vector_envs",
    "pack": "gmijax.packs.pack",
    "plan": "gmijax.roles.manager",
    "search": "gmijax.control.searching",
    "serve": "gmijax.control.serving",
    "sweep": "gmijax.sweeps.sweep",
    "task_names": "gmijax.sim.registry",
    "train": "gmijax.control.job",
}


class _Package(ModuleType):
    """`gmijax.train` is the function, also once the command's module of that name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system makes every submodule an attribute of its package.
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        # By name, as other modules: a role that names it is pickled with it.
        return importlib.import_module, (self.__name__,)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gmijax' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
