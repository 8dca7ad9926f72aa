"""gmijax: reinforcement learning in several GPU multiplexing instances (GMIs) on every GPU.

The names below are loaded when they are first used: `import gmijax` itself loads neither jax
nor mujoco.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gmijax.version import __version__

if TYPE_CHECKING:
    from gmijax.cli import compose
    from gmijax.job import Result, train
    from gmijax.sim.registry import make_env, task_names

__all__ = ["Result", "__version__", "compose", "make_env", "task_names", "train"]

_HOMES = {
    "Result": "gmijax.job",
    "compose": "gmijax.cli",
    "make_env": "gmijax.sim.registry",
    "task_names": "gmijax.sim.registry",
    "train": "gmijax.job",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gmijax' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
