"""What a child process runs first: `python -P child_start.py VERSION PATHS MODULE ARGUMENTS...`.

It loads the gmijax that this file is a part of, wherever the path leads, and then MODULE. VERSION
is that of the parent, which may have been started before another one was installed in its place.
See `gmijax.machine.interpreter`.
"""

from __future__ import annotations

import importlib.util
import os
import runpy
import sys
from pathlib import Path


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
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _load(package: Path) -> None:
    """Imports the package `gmijax` from its folder, which need not be on the path."""
    spec = importlib.util.spec_from_file_location(package.name, package / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules[package.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


if __name__ == "__main__":
    _main(*sys.argv[1:])
