"""The package `mujoco_playground`, with the robot models of gmijax and without PyTorch.

Playground looks for the robot models of MuJoCo Menagerie in its own package, and clones them
there from GitHub. Here they come from where `robot_models` finds them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from gmijax.sim.adapters.checks import attempt
from gmijax.sim.robot_models import model_folder

_TORCH_WRAPPER = "mujoco_playground._src.wrapper_torch"


def import_playground() -> Any:
    """The package `mujoco_playground`, which finds models as `robot_models` does."""
    # By name: it is not installed where gmijax is checked.
    with _torch_when_used():
        package = attempt("env=playground", importlib.import_module, "mujoco_playground")
    base: Any = importlib.import_module("mujoco_playground._src.mjx_env")
    base.MENAGERIE_PATH = _Models()
    return package


class _Models:
    """Stands for Playground's folder of models: what it asks for one is looked up."""

    def exists(self) -> bool:
        """Playground clones all models if not."""
        return True

    def __truediv__(self, name: str) -> Path:
        return model_folder(name)


@contextmanager
def _torch_when_used() -> Iterator[None]:
    """Within it, to import Playground's wrapper for PyTorch defers running it until its first use.

    It imports PyTorch, which takes seconds in every GMI.
    """
    finder = _Later()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Later(MetaPathFinder):
    """Finds the wrapper, and defers running it until its first use."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See `MetaPathFinder`."""
        spec = PathFinder.find_spec(name, path, target) if name == _TORCH_WRAPPER else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec
