"""What a user's file may import beside what is installed: the files in its folder."""

from __future__ import annotations

import importlib.abc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import packages_distributions
from pathlib import Path
from types import ModuleType


@contextmanager
def importable(folder: Path) -> Iterator[None]:
    """Has imports find the modules of a folder.

    Within the context they come before the rest of the path, as those beside a script that is run,
    but after Python's own modules and installed packages: gmijax imports these, too. Afterwards
    the folder is the last one of the path.
    """
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    finder = _Neighbours(str(folder))
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Neighbours(importlib.abc.MetaPathFinder):
    """Finds modules in one folder, before the folders of the path."""

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or fullname in sys.stdlib_module_names:
            return None  # What is inside of a package is asked of that package.
        found = PathFinder.find_spec(fullname, [self._folder], target)
        # A folder without __init__.py yields to a module of any other folder, also for Python.
        if found is None or found.loader is None or fullname in _installed():
            return None
        return found


@cache
def _installed() -> frozenset[str]:
    """Names of the modules and packages that were installed."""
    return frozenset(packages_distributions())
