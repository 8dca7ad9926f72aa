"""What a child process runs first: `python -P child_start.py VERSION PATHS MODULE ARGUMENTS...`.

It loads the gmijax that this file is a part of, wherever the path leads, and then MODULE. VERSION
is that of the parent, which may have been started before another one was installed.
See `gmijax.machine.interpreter`.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import runpy
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def _main(version: str, added: str, module: str, *arguments: str) -> None:
    package = Path(__file__).parents[1]
    _load(package)
    from gmijax.version import __version__

    if version != __version__:
        sys.exit(
            f"{package} holds gmijax {__version__} by now, and this process was started by gmijax "
            f"{version}: start the command again"
        )
    sys.path.extend(entry for entry in added.split(os.pathsep) if entry not in ("", *sys.path))
    _go_on_without_parent()
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _load(package: Path) -> None:
    """Imports the package `gmijax` from its folder, which need not be on the path."""
    spec = importlib.util.spec_from_file_location(package.name, package / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules[package.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def _go_on_without_parent() -> None:
    """Lets a stopped child see that its parent is gone, and end.

    The kernel sends the signal when the thread dies that has started the child. To a child that
    runs it means nothing, so that a thread of a parent that lives may end.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)


if __name__ == "__main__":
    _main(*sys.argv[1:])
